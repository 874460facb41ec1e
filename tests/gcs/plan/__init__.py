"""From a scenario to a flight plan: design, figures at a delay, tolerated mismatch."""
