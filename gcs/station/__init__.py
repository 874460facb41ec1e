"""The station as a pure machine: `station.step()`, the monitor, and when a flight ends."""
