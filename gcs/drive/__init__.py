"""The drivers that run a station: `udp` in real time, `lockstep` in virtual time, with its only sockets and clocks.

`fly` does everything that `gcs fly` does after parsing options; `flown` flies a plan and returns its log. `preflight`
refuses scenarios that cannot fly; `check` reports what would be flown.
"""
