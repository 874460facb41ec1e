"""The definition of an experiment. `schema` and `keys` define its keys, `files` reads and checks them, `shipped` finds
the scenarios that ship, `networks` numbers vehicles, `signing` signs links.

`kernel` with `kernel_cache` and `handle`, `sockets`, `undisturbed`, `hypot`, `errors` and `networks` are here because
station and vehicles share them: neither package may import the other."""
