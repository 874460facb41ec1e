"""The delay margin of any linear loop, against oracles and benchmarks."""
