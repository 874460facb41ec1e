"""`gcs stress`: campaigns of flights over delays and what else links do, and where formations break."""
