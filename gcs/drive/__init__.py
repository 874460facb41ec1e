"""What runs a station: `udp` in real time, `lockstep` in virtual time. The station's only sockets and clocks.

`fly` is the whole of `gcs fly` after the options; `preflight` holds the checks before take-off.
"""
