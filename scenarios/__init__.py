"""The definition of an experiment. `schema` and `keys` define its keys, `files` reads and checks them, `shipped` finds
the scenarios that ship, `networks` numbers vehicles, `signing` signs links.

There are more than twelve files because this package also has what station and vehicles share, neither of which may
import the other: `kernel` with `kernel_cache` and `handle`, `sockets`, `undisturbed`, `hypot`, `errors`, `networks`.
"""
