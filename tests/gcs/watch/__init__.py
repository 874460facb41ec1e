"""Links watched, and telemetry logs read, rebuilt and exported."""
