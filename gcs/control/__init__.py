"""The control tick: from the newest states to commands and their loop delay.

Begin at `law`, the control law. `loops` says what depends on where the loop is closed, `loop_delay` defines loop delay
and headroom, `tick` the columns of the tick record.
"""
