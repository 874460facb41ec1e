"""From a scenario to its formation, design and flight plan.

Open `planner` first. `formation` says who follows whom, `design` is the record of the gains, and `flight_plan` is what
the station is made from. `given` makes a scenario with gains from elsewhere. Each other file answers one question about
a design: `criteria`, `at_delay`, `expected_delay`, `loops`, `disturbed`, `mismatch`, `onboard`, `course`, `own_law`.
"""
