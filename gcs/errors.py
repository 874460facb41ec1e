"""The error that a user is shown as one line."""


class InputError(Exception):
    """The user's input cannot be used: one line with what was read and what was wanted; exit code 2."""
