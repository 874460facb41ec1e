"""Emulated links: delay, jitter, loss and shared channels; and the truth log of what happened on them."""
