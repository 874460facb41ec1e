"""The flight plan: formation, gains and their delay margins, as the station flies them."""

from dataclasses import dataclass, replace
from functools import cached_property

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.sampled.multirate import Timing
from gcs.plan.formation import Formation
from gcs.plan.mismatch import Tolerance, tolerance
from gcs.plan.responses import Responses
from scenarios.schema import Scenario


@dataclass(frozen=True)
class FlightPlan:
    """What the station flies: the formation, the gains and the margin they have."""

    scenario: Scenario
    formation: Formation
    gain: FloatArray
    """K of u = K e, rows and columns in the order of `gains.formation.model.FormationModel`."""
    delay_margin_s: float
    slower: tuple[tuple[FloatArray, float], ...] = ()
    """The rest of the gain schedule: gain matrices with larger and larger delay margins, and these margins."""
    separable: bool = True
    """Whether every vehicle's loop has a margin of its own, as in a leader-follower tree."""
    responses: Responses | None = None
    """The vehicles' responses; None if they are immediate, or not yet known."""
    around_loss: tuple[FloatArray, ...] = ()
    """Flown in place of `gains` while a vehicle is lost; empty if those serve. A leader-follower tree stays stable when
    the nearest vehicle ahead stands in for a lost one. Gains on another pattern may need all of their terms, so
    inclusion gains of the same delay margin replace them; the step in the commands is accepted."""

    @cached_property
    def gains(self) -> tuple[FloatArray, ...]:
        """The gain schedule, fastest first."""
        return (self.gain, *(gain for gain, _ in self.slower))

    @cached_property
    def margins_s(self) -> tuple[float, ...]:
        """The delay margins of the gain schedule."""
        return (self.delay_margin_s, *(margin_s for _, margin_s in self.slower))

    @cached_property
    def tolerance(self) -> Tolerance:
        """By how much the loop delay may miss the one that the station assumes."""
        return tolerance(self.scenario.control.prediction, self.model, self.gains, self.margins_s, self.timing)

    @property
    def assumed_s(self) -> float | None:
        """The given loop delay over which the station predicts; None without prediction, or if it is measured."""
        prediction = self.scenario.control.prediction
        return None if isinstance(prediction, str) else prediction

    @property
    def model(self) -> FormationModel:
        """The formation's error model."""
        return self.formation.model

    @property
    def timing(self) -> Timing:
        """How often the station hears and commands."""
        return loop_timing(self.scenario)

    def with_margins(self, margins_s: tuple[float, ...], responses: Responses | None) -> "FlightPlan":
        """The plan with the margins that the same gains have on vehicles with these responses."""
        slower = tuple((gain, s) for (gain, _), s in zip(self.slower, margins_s[1:], strict=True))
        return replace(self, delay_margin_s=margins_s[0], slower=slower, responses=responses)


def loop_timing(scenario: Scenario) -> Timing:
    """The periods at which states and commands of a scenario are sent."""
    return Timing(1.0 / scenario.rates.control_hz, 1.0 / scenario.rates.telemetry_hz)
