"""The station without sockets and clocks: datagrams and the time in, datagrams and ticks out.

Begin at `station`. `reception` takes datagrams in, `fleet_kind` chooses the kind of vehicles, `monitor` decides on
modes and gains, `journal` takes the events, `tick_rows` fills the tick record.
"""
