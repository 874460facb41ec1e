"""The control tick: from the newest states to commands and their loop delay.

Begin at `law`, the control law. `loops` has the variants by where the loop is closed, `fleet` what depends on the kind
of vehicles; `loop_delay` defines loop delay and headroom, `tick` the columns of the tick record. There are more than
twelve files because prediction takes four: `prediction` from the set-points sent, `responding` through a vehicle's
response, `acted` corrected by the set-points that vehicles report, and `predicted_stream` with loops on board.
"""
