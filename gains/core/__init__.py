"""What all other rooms use: array types, errors, blocks of a matrix, roots in brackets, semidefinite programs."""
