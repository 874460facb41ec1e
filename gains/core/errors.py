"""Exceptions of the control mathematics::

ValueError
└── GainsError             what `gains` raises on purpose
    ├── BadModelError      an argument is not what was wanted: its shape, its sign, not finite
    ├── InfeasibleError    the design problem has no solution for the data given
    ├── SolverError        the optimiser stopped without a solution that can be trusted
    └── DisagreementError  independent methods give different answers to one question
"""


class GainsError(ValueError):
    """Base of every exception that `gains` raises on purpose."""


class BadModelError(GainsError):
    """An argument is not what was wanted; the message names what was read and what was wanted."""


class InfeasibleError(GainsError):
    """The design problem has no solution for the data given; the message says what to relax."""


class SolverError(GainsError):
    """The optimiser stopped without a solution that can be trusted; the message names its status."""


class DisagreementError(GainsError):
    """Independent methods give different answers to one question; the message lists the answer of each."""
