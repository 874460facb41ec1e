"""Emulated links. `fate` decides what happens to a datagram, `links` carries it, `truth` records what happened."""
