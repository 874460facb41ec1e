"""How vehicles with autopilots respond to set-points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from gains.performance.response import Response
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
