"""The control tick: states at one instant, the control law, limits, loop delay, phases, the tick record."""
