"""What the frames on a link or in a telemetry log say about latency. Nothing is commanded here.

Begin at `links`, which both use: `live` for `gcs monitor`, `rebuild` for `gcs replay`. `for_link` chooses gains for the
links in a log, or for those that `before_flight` measures.
"""
