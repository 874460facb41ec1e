"""How vehicles with autopilots respond to set-points, and the margins with these responses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.performance.response import Response, sampled_margin
from gains.sampled.multirate import Timing
from scenarios.schema import Scenario


@dataclass(frozen=True)
class Responses:
    """The response of each vehicle by system id, and where it is from."""

    source: Literal["given", "identified"]
    of: Mapping[int, Response]

    def in_order(self, system_ids: Sequence[int]) -> list[Response]:
        """The responses of these vehicles."""
        return [self.of[system_id] for system_id in system_ids]


def given_responses(scenario: Scenario) -> Responses | None:
    """The scenario's response, as that of each of its vehicles."""
    given = scenario.response
    if given is None:
        return None
    response = Response(given.lag_s, given.velocity_gain_1_s)
    return Responses("given", {vehicle.system_id: response for vehicle in scenario.vehicles})


def margins_with(
    model: FormationModel, gains: Sequence[FloatArray], responses: Sequence[Response] | None, timing: Timing
) -> tuple[float, ...]:
    """The sampled delay margin of each gain matrix with these responses, one for each vehicle of the model."""
    return tuple(sampled_margin(model, K, responses, timing=timing) for K in gains)
