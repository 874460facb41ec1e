"""From a requirement to gains. `design` is the way in; it takes one of two routes.

Inclusion: `required` turns a requirement into one `search` for the gains of a follower. Graph: `graph` takes base gains
from `structured_lqr` (cost in `lqr`) or `dk_iteration`, and `time_scale` brings them to the requirement. `for_delay`
searches gains for a loop delay and everything else that is asked for. `robust_lmi` has designs to compare with.

The routes share no step, so that this room has one file more than twelve.
"""
