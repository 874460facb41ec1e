"""Continuous loops with constant delays: windows of stability, delay margins, rightmost roots. Begin at `constant`."""
