"""The documentation: it says what the code does, and its examples run."""
