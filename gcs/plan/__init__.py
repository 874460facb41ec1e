"""From a scenario to its formation, design and flight plan.

Open `planner` first. `formation` says who follows whom, `design` is the record of the gains, and `flight_plan` is what
the station is made from. Every other file answers one question about a design, hence their number: `criteria`,
`at_delay`, `expected_delay`, `loops`, `disturbed`, `mismatch`, `onboard`, `course`, `own_law`. `given` makes a scenario
with gains from elsewhere.
"""
