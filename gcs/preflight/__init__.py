"""What is reported about a scenario before its flight, for `gcs check` and for the commands that would fly it.

`faults` finds why a scenario cannot be flown; `check` reports what would be flown, with the headroom expected over the
links; `channels` flies the start of a scenario to find how long its datagrams wait for bandwidth.
"""
