"""Drivers of the vehicles: `fleet` as a function of datagrams and time, `udp` in real time, `cli` as a command."""
