"""Shared by all other rooms: array types, errors, blocks of a matrix, bracketed roots, semidefinite programs."""
