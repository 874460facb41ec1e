"""What every part of the mathematics needs: array types, errors, block structure, bracketing, requirements."""
