"""What contradicts `control.for_link`, with which gains are chosen for measured links."""

from collections.abc import Iterator

from scenarios.keys.part import Fault
from scenarios.schema import Scenario

_MEASURED = "at_delay_s", "delays_s", "delay_rate"


def contradictions(scenario: Scenario) -> Iterator[Fault]:
    """Keys that exclude each other where gains are chosen for measured links."""
    control, key = scenario.control, "control.for_link"
    if control.for_link == "off":
        return
    required = control.alpha or control.delay_margin_s or control.decay_rate_1_s
    if required or control.gains is not None or control.blocks:
        yield key, control.for_link, "off, with gains, blocks, alpha, delay_margin_s or decay_rate_1_s"
    if control.method != "inclusion" or control.loop != "ground":
        yield key, control.for_link, "off, unless method is inclusion and loop is ground"
    if control.prediction != "off" or scenario.dynamics == "autopilot":
        yield key, control.for_link, "off, with prediction or dynamics autopilot"
    if control.criteria is None:
        return
    for name in _MEASURED:
        if (value := getattr(control.criteria, name)) is not None:
            yield f"control.criteria.{name}", value, "no such key with for_link: the delays are measured"
    if control.criteria.maximise == "delay_margin_s":
        yield "control.criteria.maximise", control.criteria.maximise, "alpha or decay_rate_1_s, with for_link"
