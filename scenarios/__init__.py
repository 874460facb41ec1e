"""The definition of an experiment. `schema` and `keys` define its keys, `files` reads and checks them, `shipped` finds
the scenarios that ship, `networks` numbers vehicles, `signing` signs links.

It has more than twelve files because it also holds what station and vehicles share, as neither may import the other:
`kernel` with `kernel_cache` and `handle`, `sockets`, `undisturbed`, `hypot`, `errors`, `networks`.
"""
