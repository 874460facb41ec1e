"""From a scenario to what is flown: formation, design and flight plan.

Begin at `planner`; `design` is the record of a design, `flight_plan` that of what the station flies.
"""
