"""Tests of how simulated vehicles move."""
