"""The control tick: commands, limits, loop delay, phases and prediction."""
