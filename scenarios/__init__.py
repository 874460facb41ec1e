"""What an experiment is. `schema` and `keys` have its keys, `files` reads and checks them, `shipped` finds the
scenarios that ship, `networks` numbers vehicles, `signing` signs links.

There are more than twelve files because `kernel`, `sockets`, `undisturbed`, `hypot`, `errors` and `networks` are what
station and vehicles share: neither package may import the other."""
