"""Control mathematics of formations: gains for an information pattern, and the delay margins of their loops.

Most users need only the two dozen names below; importing one loads only what it needs. The rest is imported from the
rooms, for example `from gains.formation.pattern import leader_follower`. Each room uses those above it:

* `core`: requirements, errors, array types, and the splitting of a matrix into interacting blocks.
* `formation`: formation models and information patterns, the inclusion principle, partitions, fixed modes.
* `delay`: loops with constant delays: stability windows, delay margins, rightmost roots, two independent delays.
* `sampled`: loops as flown: sampled and held, telemetry at another rate, own errors fed back on board.
* `varying`: delays that vary: bounds within which a loop is proved stable.
* `margin`: the engine of `gcs margin`: any linear loop from one description, confirmed by second opinions.
* `performance`: performance of given gains: robustness, growth down the chain, vehicles that respond with a lag.
* `criteria`: requirements beyond margin, robustness and decay, as figures of given gains.
* `design`: from a requirement to gains.

A module whose name begins with an underscore is internal. `gains.design` is the function; modules of that room are
imported as `from gains.design import lqr`. Matrices are arrays or nested lists; A, B and K are those of
x' = A x + B u, u = +K x. Times are in s, frequencies in rad/s, state matrices in 1/s.

Gains for a leader and two followers with a margin of 0.3 s at 50 Hz; without sampling it is half a period more:

>>> from gains import FormationModel, Requirement, delay_margin, design
>>> chain = FormationModel((-1, 0, 1))
>>> found = design(chain, Requirement(delay_margin_s=0.3), period_s=0.02)
>>> round(found.delay_margin_s, 3), round(delay_margin(*chain.ground_loop(found.K1, found.K2, found.K3)), 3)
(0.3, 0.31)
"""

import sys
from types import ModuleType

# stands for `typing.TYPE_CHECKING`: importing `typing` would take far longer than importing this package
TYPE_CHECKING = False
if TYPE_CHECKING:
    from gains.core.errors import BadModelError, DisagreementError, GainsError, InfeasibleError, SolverError
    from gains.core.requirement import Requirement
    from gains.delay.constant import analyse_delay, delay_margin
    from gains.delay.rightmost import rightmost_root
    from gains.delay.several import delay_box
    from gains.design.design import design, evaluate_gains, trade_off
    from gains.formation.model import FormationModel
    from gains.margin.loop_margin import loop_margin
    from gains.margin.model_file import parse_model
    from gains.margin.open_loop import delayed_feedback
    from gains.margin.opinions import checked_delay_margin
    from gains.performance.response import Response
    from gains.performance.robust import robustness
    from gains.sampled.constant import sampled_delay_margin
    from gains.sampled.multirate import Timing, multirate_delay_margin
    from gains.sampled.prediction import mismatch_window
    from gains.varying.bounds import varying_delay_bound

__all__ = [
    "BadModelError", "DisagreementError", "FormationModel", "GainsError", "InfeasibleError", "Requirement",
    "Response", "SolverError", "Timing", "analyse_delay", "checked_delay_margin", "delay_box", "delay_margin",
    "delayed_feedback", "design", "evaluate_gains", "loop_margin", "mismatch_window", "multirate_delay_margin",
    "parse_model", "rightmost_root", "robustness", "sampled_delay_margin", "trade_off", "varying_delay_bound",
]  # fmt: skip

_NAMES = {
    "core.errors": "BadModelError DisagreementError GainsError InfeasibleError SolverError",
    "core.requirement": "Requirement",
    "delay.constant": "analyse_delay delay_margin",
    "delay.rightmost": "rightmost_root",
    "delay.several": "delay_box",
    "design.design": "design evaluate_gains trade_off",
    "formation.model": "FormationModel",
    "margin.loop_margin": "loop_margin",
    "margin.model_file": "parse_model",
    "margin.open_loop": "delayed_feedback",
    "margin.opinions": "checked_delay_margin",
    "performance.response": "Response",
    "performance.robust": "robustness",
    "sampled.constant": "sampled_delay_margin",
    "sampled.multirate": "Timing multirate_delay_margin",
    "sampled.prediction": "mismatch_window",
    "varying.bounds": "varying_delay_bound",
}
_HOME = {name: f"gains.{module}" for module, names in _NAMES.items() for name in names.split()}


class _Package(ModuleType):
    """Class of this package: keeps the name `design` for the function when the room `gains.design` is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
