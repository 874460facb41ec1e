"""Delays that vary in time: bounds below which a loop is proved stable. Begin at `jitter` or `predicted`."""
