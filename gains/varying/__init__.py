"""Delays that vary in time: bounds below which a loop is proved stable. Begin at `jitter`, with prediction at `predicted`."""
