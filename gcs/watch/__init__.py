"""What the frames on a link or in a telemetry log say about latency, without commanding anything."""
