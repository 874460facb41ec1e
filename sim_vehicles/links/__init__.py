"""Emulated links: delay, jitter, loss, shared channels; and the log of what really happened."""
