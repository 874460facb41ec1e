"""Gains and their delay margins: known answers, brackets and names of the whole package."""
