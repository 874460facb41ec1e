"""Whole flights with other loops than the plain one: predicted, on board, manoeuvring, disturbed, user-supplied."""
