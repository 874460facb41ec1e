"""The definition of an experiment. `schema` and `keys` define its keys, `files` reads and checks them, `shipped` finds
the scenarios that ship, `networks` numbers vehicles, `signing` signs links.

The package also holds the code that station and vehicles share, because neither may import the other: `kernel` with
`kernel_cache` and `handle`, `sockets`, `undisturbed`, `hypot`, `errors`, `networks`.
"""
