"""The fleet, a function of datagrams and time; the command `sim-vehicles`, its UDP sockets and its signing."""
