"""From a scenario to what is flown: formation, design and flight plan."""
