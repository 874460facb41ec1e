"""`gcs bench --peers`: the same work by this station and by other people's tools, in one run.

`rows` makes the table and names the peers that are not installed. Each station flies in a process of its own, a script
that `closed_loop` starts beside the simulated vehicles: `own_station`, and `pymavlink_station` and `mavsdk_station`,
plain ones that share the law and the clockwork of `plain`. `aircraft` steps JSBSim, also in a process of its own.
"""
