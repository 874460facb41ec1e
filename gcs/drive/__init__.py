"""Drivers in real time (UDP) and in virtual time (lockstep). The only sockets and clocks of the station."""
