"""From a requirement to gains. `design` is the way in; it takes one of two routes.

Inclusion: `required` turns a requirement into one `search` for the gains of a follower. Graph: `graph` takes base gains
from `structured_lqr` (cost in `lqr`) or `dk_iteration`, and `time_scale` brings them to the requirement. `robust_lmi`
has the designs that others are compared with.
"""
