"""The delay margin of any linear loop, confirmed by second opinions; the engine of `gcs margin`."""
