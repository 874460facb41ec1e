"""From a scenario to what is flown: formation, design and flight plan.

`planner` is the way in: `formation` says who follows whom, `design` is the record of the gains and `flight_plan` what
the station is made from. Every other file answers one question about a design, so that there are more than twelve:
`criteria`, `at_delay`, `expected_delay`, `loops`, `disturbed`, `mismatch`, `onboard`, `course`, `own_law`. `given`
makes a scenario with gains from elsewhere.
"""
