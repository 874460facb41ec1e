"""What an experiment is. `schema` has the keys of a scenario, `files` reads and checks them, `signing` signs links."""
