"""`gcs monitor` and `gcs replay`: what links and telemetry logs say, without a say in the flight."""
