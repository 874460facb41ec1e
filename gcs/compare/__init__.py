"""`gcs compare`: the design routes side by side."""
