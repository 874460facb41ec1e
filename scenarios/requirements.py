"""Contradictions in `control.criteria` and `control.overlap`, and in `control.for_link`, which measures delays."""

from collections.abc import Iterator

from scenarios.errors import InWords
from scenarios.keys.criteria import Criteria
from scenarios.keys.part import Fault
from scenarios.schema import Scenario

_AT_DELAY = "alpha_at_delay", "decay_rate_at_delay_1_s"
_MEASURED = "at_delay_s", "delays_s", "delay_rate"
_WITHOUT_DELAY = "damping_min", "natural_frequency_max_rad_s"


def response_wanted(dynamics: str) -> str:
    """What an error about a missing response says is wanted, and where its values are found."""
    found = "a flight leaves in design.json" if dynamics == "autopilot" else "gcs identify finds"
    return f"a [response], which {found}"


def contradictions(scenario: Scenario) -> Iterator[Fault]:
    """Faults of `control.criteria`, `control.overlap` and `control.for_link` that no single key shows."""
    yield from _criteria_contradictions(scenario)
    yield from _for_link_contradictions(scenario)


def _criteria_contradictions(scenario: Scenario) -> Iterator[Fault]:
    control, criteria = scenario.control, scenario.control.criteria
    given = control.gains is not None or control.blocks
    if control.overlap is not None and (control.method == "inclusion" or given):
        wanted = "no such key, unless method is graph-lqr or graph-dk, with gains designed"
        yield "control.overlap", control.overlap.model_dump(), wanted
    if criteria is None:
        return
    if given:
        yield "control.criteria", InWords("requirements"), "either criteria, or gains or blocks"
    if control.loop == "onboard":
        yield "control.loop", control.loop, "ground, with control.criteria"
    if scenario.dynamics != "double_integrator":
        yield from _late_contradictions(scenario, criteria)
    if control.prediction != "off":
        yield "control.criteria", InWords("requirements"), "no such key with prediction"
    low, high = criteria.delays_s or (0.0, 0.0)
    if low > high:
        yield "control.criteria.delays_s", [low, high], "the smaller delay first"
    if criteria.delays_s is None and criteria.delay_rate is not None:
        yield "control.criteria.delay_rate", criteria.delay_rate, "no such key without delays_s"
    if criteria.at_delay_s is not None:
        return
    for name in (*_AT_DELAY, "discrete"):
        if value := getattr(criteria, name):
            yield f"control.criteria.{name}", value, "no such key without at_delay_s"
    if criteria.maximise in _AT_DELAY:
        yield "control.criteria.maximise", criteria.maximise, "a figure that needs no delay, without at_delay_s"


def _late_contradictions(scenario: Scenario, criteria: Criteria) -> Iterator[Fault]:
    """Contradictions in the criteria for vehicles that do not respond at once."""
    whose, wanted = f"with dynamics {scenario.dynamics}", "it is for vehicles that respond at once"
    if scenario.control.for_link == "off":
        yield "control.criteria", InWords("requirements"), f"no such key {whose} and without for_link: {wanted}"
    for name in _WITHOUT_DELAY:
        if value := getattr(criteria, name):
            yield f"control.criteria.{name}", value, f"no such key {whose}: {wanted}"


def _for_link_contradictions(scenario: Scenario) -> Iterator[Fault]:
    control, key = scenario.control, "control.for_link"
    if control.for_link == "off":
        return
    required = control.alpha or control.delay_margin_s or control.decay_rate_1_s
    if required or control.gains is not None or control.blocks:
        yield key, control.for_link, "off, with gains, blocks, alpha, delay_margin_s or decay_rate_1_s"
    if control.method != "inclusion" or control.loop != "ground":
        yield key, control.for_link, "off, unless method is inclusion and loop is ground"
    if control.prediction != "off":
        yield key, control.for_link, "off, with prediction: it is chosen together with the gains"
    if scenario.dynamics != "double_integrator" and scenario.response is None:
        wanted = f"off, with dynamics {scenario.dynamics}, or {response_wanted(scenario.dynamics)}"
        yield key, control.for_link, wanted
    if control.criteria is None:
        return
    for name in _MEASURED:
        if (value := getattr(control.criteria, name)) is not None:
            yield f"control.criteria.{name}", value, "no such key with for_link: the delays are measured"
    if control.criteria.maximise == "delay_margin_s":
        yield "control.criteria.maximise", control.criteria.maximise, "alpha or decay_rate_1_s, with for_link"
