"""What an experiment is. `schema` has its keys, `files` reads and checks them, `signing` signs links."""
