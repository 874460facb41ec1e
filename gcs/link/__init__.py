"""The conversation with one vehicle. Begin at `vehicle`.

It uses the codec (`mavlink`), sequence numbers, clocks, and what depends on the kind of vehicle (`kinds`, `startup`).
"""
