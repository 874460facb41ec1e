"""Campaigns, free responses, and the map of where a formation breaks."""
