"""The vehicles of each kind: motion, commands, failsafe, and hostile datagrams."""
