"""The studies: capacity, comparison, and the source reproduced."""
