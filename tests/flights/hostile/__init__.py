"""Whole flights under attack or with clocks that jump: bytes at random, replays, signatures."""
