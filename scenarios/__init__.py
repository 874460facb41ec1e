"""What an experiment is. `schema` and `keys` have its keys, `files` reads and checks them, `shipped` finds the
scenarios that ship, `signing` signs links."""
