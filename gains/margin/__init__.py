"""The delay margin of any linear loop, with second opinions: the engine of `gcs margin`. Begin at `loop_margin`."""
