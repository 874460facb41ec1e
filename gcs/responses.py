"""How vehicles with autopilots answer to set-points, and the margins with that."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from gains.behaviour import Gains
from gains.response import Response, sampled_margin
from scenarios.schema import Scenario


@dataclass(frozen=True)
class Responses:
    """The response of each vehicle by system id, and where it is from."""

    source: Literal["given", "identified"]
    of: Mapping[int, Response]


def given_responses(scenario: Scenario) -> Responses | None:
    """The scenario's response, as that of each of its vehicles."""
    given = scenario.response
    if given is None:
        return None
    response = Response(given.lag_s, given.velocity_gain_1_s)
    return Responses("given", {vehicle.system_id: response for vehicle in scenario.vehicles})


def margins_with(schedule: Sequence[Gains], responses: Sequence[Response], *, period_s: float) -> tuple[float, ...]:
    """The sampled delay margin of each set of gains, that of the vehicle with the least."""
    return tuple(sampled_margin(gains, responses, period_s=period_s) for gains in schedule)
