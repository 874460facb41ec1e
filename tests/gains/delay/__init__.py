"""Continuous loops with constant delays: windows of stability, and several delays at once."""
