"""From a requirement to gains. `design` is the entry point; it takes one of two routes.

Inclusion: `required` turns a requirement into one `search` for the gains of a follower. Graph: `graph` takes base gains
from `structured_lqr` (cost in `lqr`) or `dk_iteration`, and `time_scale` brings them to the requirement. For both,
`for_delay` searches for gains at a loop delay that meet further criteria, and `predicted` for gains with prediction.
`front` compares both routes over many delays. `robust_lmi` has designs to compare with. The room has one file more than
twelve, as each method is read on its own.
"""
