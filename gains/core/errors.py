"""Exceptions of the control mathematics::

ValueError
└── GainsError             what `gains` raises on purpose
    ├── BadModelError      an argument has a wrong shape, sign or type, or is not finite
    ├── InfeasibleError    the design problem has no solution for the data given
    ├── SolverError        the optimiser stopped without a trustworthy solution
    └── DisagreementError  independent methods give different answers to one question
"""


class GainsError(ValueError):
    """Base of every exception that `gains` raises on purpose."""


class BadModelError(GainsError):
    """An argument is invalid; the message states the value read and the value wanted."""


class InfeasibleError(GainsError):
    """The design problem has no solution for the data given; the message says what to relax."""


class SolverError(GainsError):
    """The optimiser stopped without a trustworthy solution; the message names its status."""


class DisagreementError(GainsError):
    """Independent methods give different answers to one question; the message lists each answer."""
