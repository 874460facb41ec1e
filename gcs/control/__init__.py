"""The control tick: from the newest states to commands and their loop delay.

Begin at `law`, the control law. `loops` says what depends on where the loop is closed, `fleet` what depends on the kind
of vehicles, `loop_delay` defines loop delay and headroom, `tick` the columns of the tick record. There are more than
twelve files because prediction has four, each a step of its own: `prediction` from set-points, `responding` through a
vehicle's response, `acted` as vehicles report them, and `predicted_stream` with loops on board.
"""
