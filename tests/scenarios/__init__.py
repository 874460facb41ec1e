"""Scenarios and their keys: what is read, checked and refused."""
