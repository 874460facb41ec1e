"""The drivers that run a station: `udp` in real time, `lockstep` in virtual time, with its only sockets and clocks.

`udp_fast_path` and `fast_path` are their kernels for steps that need no Python. `fly` does everything that `gcs fly`
does after parsing options; `flown` flies a plan and returns its log.
"""
