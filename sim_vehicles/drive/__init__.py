"""The fleet in real time: command line, UDP sockets, signing."""
