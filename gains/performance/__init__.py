"""Performance of given gains. `gains.design` uses these modules to find gains.

`robust`: the disturbance a loop withstands. `string_stability`: how errors grow down a chain. `behaviour`: decay,
damping and growth inside the margin. `flown`: robustness and string stability at a loop delay. `response`: vehicles
that respond with a lag. `scalar_gains`: the formulas of one follower, for many gains at once.
"""
