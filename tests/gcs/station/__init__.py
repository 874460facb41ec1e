"""The station without sockets: its conversation, its monitor, and when a flight breaks."""
