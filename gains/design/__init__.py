"""From a requirement to gains: the inclusion, graph, LQR and D-K routes."""
