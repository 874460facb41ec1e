"""Measures latency from the frames on a link or in a telemetry log, without commanding anything.

Begin at `links`, on which the others build: `live` for `gcs monitor`, `rebuild` for `gcs replay`. `for_link` chooses
gains for the links in a log, or for those that `before_flight` measures.
"""
