"""The conversation with one vehicle. Begin at `vehicle`.

It uses the codec (`mavlink`), sequence numbers, clocks, and the traits of each kind of vehicle (`kinds`, `startup`).
"""
