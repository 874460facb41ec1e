"""What the frames on a link or in a telemetry log say about latency. Nothing is commanded here."""
