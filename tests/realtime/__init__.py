"""Real processes, real UDP and the real clock."""
