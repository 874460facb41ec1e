"""The commands as a user types them, in processes and terminals of their own."""
