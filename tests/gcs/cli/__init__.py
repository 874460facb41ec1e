"""The commands: options, refusals in one line, and what is printed."""
