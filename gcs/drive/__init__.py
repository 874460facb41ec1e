"""What runs a station: `udp` in real time, `lockstep` in virtual time. The station's only sockets and clocks.

`fly` is the whole of `gcs fly` after the options, `flown` flies a plan and returns its log. `preflight` refuses what
cannot fly, `check` says what would be flown.
"""
