"""Random experiments in virtual time whose invariants are checked; some of them run as a test."""
