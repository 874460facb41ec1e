"""Fly and judge one experiment of the soak: refused, or flown and checked by `soak_checks.py`."""

import re
import traceback
from dataclasses import dataclass

from gains.core.errors import DisagreementError, GainsError, SolverError
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.preflight.faults import bad_start, endless_link, unstable_loop, without_actions
from gcs.stress.measure import fly_trial
from gcs.stress.trial import Trial, sparse_gain
from tests.soak.soak_checks import Broken, checked
from tests.soak.soak_experiments import Experiment, experiment
from tests.soak.soak_flight import fly


@dataclass(frozen=True)
class Result:
    """What came of one experiment."""

    broken: tuple[Broken, ...] = ()
    refused: str = ""
    """Why the scenario was not flown; numbers are left out."""
    ended: str = ""
    """The kind of the flight's end, or the finding on its margin."""


class RefusalError(Exception):
    """The scenario is refused before take-off, as it should be."""


def judge(experiment: Experiment) -> Result:
    """Fly an experiment and check everything."""
    try:
        plan = _plan(experiment)
        if experiment.margin_ratio is not None:
            return _margin_kept(plan, experiment.margin_ratio)
        return _flown(experiment, plan)
    except RefusalError as refused:
        return Result(refused=str(refused))
    except DisagreementError as error:
        return Result((Broken("independent methods agree", str(error)),))
    except Exception:  # noqa: BLE001 - any exception is what the soak looks for
        return Result((Broken("no exception", traceback.format_exc()),))


def _plan(experiment: Experiment) -> FlightPlan:
    """The plan as `gcs fly` makes it."""
    scenario = experiment.scenario
    if (refusal := bad_start(scenario) or endless_link(scenario)) is not None:
        raise RefusalError(_kind_of(refusal))
    try:
        _, plan = flight_plan(scenario)
    except DisagreementError:
        raise
    except GainsError as error:
        if isinstance(error, SolverError) and (scenario.control.gains or scenario.control.blocks):
            raise
        raise RefusalError(f"{type(error).__name__}: {_kind_of(str(error))}") from None
    if (unstable := unstable_loop(plan)) is None:
        return plan
    if not experiment.allow_unstable:
        raise RefusalError(_kind_of(unstable))
    return without_actions(plan)


def _kind_of(refusal: str) -> str:
    """The first words of a refusal, without its numbers."""
    return " ".join(re.sub(r"[-+±]?\d[\d.e+-]*j?", "#", refusal).replace(" ±", "").split()[:10])


def _flown(experiment: Experiment, plan: FlightPlan) -> Result:
    flown = fly(experiment, plan)
    broken = list(checked(flown))
    if experiment.twice and fly(experiment, plan).sha256 != flown.sha256:
        broken.append(Broken("the same bytes twice", "a second flight differs"))
    return Result(tuple(broken), ended=flown.stretches[-1].station.end_reason.split(":")[0])


def _margin_kept(plan: FlightPlan, ratio: float) -> Result:
    """Errors decay below 0.9 of the plan's margin; they grow above 1.1 of it, and if there is no margin.

    The growth rate is the one that a campaign's probe fits to a flight in virtual time, at the flight's loop delay.
    """
    margin_s, timing = plan.delay_margin_s, plan.timing
    # less the mean time that a state waits for the next tick
    wanted_s = ratio * min(margin_s, 2.0) - 0.5 * min(timing.control_s, timing.telemetry_s)
    if margin_s == 0.0:
        wanted_s = 0.0
    elif wanted_s <= 0.0:
        return Result(ended="margin: below half a period")
    delayed = plan.scenario.with_link_delay(up_s=wanted_s / 2.0, down_s=wanted_s / 2.0)
    found = fly_trial(Trial(delayed, sparse_gain(plan.gain), margin_s, "probe"))
    if found.error is not None:
        return Result((Broken("no exception", found.error),))
    if found.growth_1_s is None or found.loop_delay_s is None:
        return Result(ended=f"margin: no growth could be fitted{' to an unstable loop' if margin_s == 0.0 else ''}")
    share = found.loop_delay_s / margin_s if margin_s > 0.0 else 2.0
    growth, error = found.growth_1_s, found.growth_error_1_s
    text = f"grows by {growth:.4f} 1/s (± {error}) at {share:.3f} of the margin of {margin_s:.4f} s"
    # A free integrator has no margin either, and its errors stay constant except for rounding: float32 rounds positions
    # of 2 km by 1e-4 m, for errors of a metre within 20 s.
    stays = -3.0 * (error or 0.0) - 2e-5 if margin_s == 0.0 else 0.0
    if (share < 0.9 and growth > 0.0) or (share > 1.1 and growth < stays):
        return Result((Broken("margin", text),))
    where = "stable below" if share < 0.9 else "near it" if share <= 1.1 else "unstable above"
    return Result(ended=f"margin: {where if margin_s > 0.0 else 'none, and unstable'}")


def fly_numbers(seed: int, numbers: list[int]) -> list[tuple[int, Result]]:
    """Some flights of a seed. Defined here because worker processes do not import a `__main__`."""
    return [(number, judge(experiment(seed, number))) for number in numbers]
