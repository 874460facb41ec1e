"""What all other rooms use: array types, errors, blocks of a matrix, bracketing, semidefinite programs, requirements."""
