"""The station without sockets and clocks: datagrams and the time in, datagrams and ticks out.

Begin at `station`. `reception` processes received datagrams, `fleet_kind` chooses the kind of vehicles, `monitor`
decides modes and gains, `journal` records events, `tick_rows` fills the tick record. `fast_path` does
most steps in kernels.
"""
