"""The summary of a run: frozen records with the fields of summary.json.

`gcs.runs.summary` makes them from the logs of a run; `gcs.runs.files` reads them back.
"""

from math import isfinite
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer

from gcs.control.tick import Event
from gcs.plan.design import CodeRecord, FiguresAtDelay, ResponsePart
from gcs.published import Published
from gcs.runs.record import STARTED, event_fields


def rounded(value: Any) -> Any:
    """Round a float to nine decimals; None if it is not finite, because JSON has no infinity or NaN."""
    if not isinstance(value, float):
        return value
    return round(float(value), 9) if isfinite(value) else None


Number = Annotated[float | None, BeforeValidator(rounded)]
"""A number; None where it is unknown or unbounded."""


class Spread(Published):
    """Percentiles and maximum of a quantity; None without a sample."""

    p50: Number
    p95: Number = None
    p99: Number
    max: Number


class Estimate(Spread):
    """The spread of an estimate, with the number of its samples."""

    samples: int
    status: str


class OneWayDelay(Estimate):
    """The spread of a one-way delay, and the largest error that the vehicle's clock can cause in it."""

    bound_s: Number


class MarginRange(Published):
    """The delay margins of the gains that a vehicle was flown with."""

    min: Number
    max: Number


class Clock(Published):
    """A vehicle's boot clock against the station's."""

    status: str
    samples: int
    offset_s: Number
    bound_s: Number
    skew_ppm: Number
    skew_bound_ppm: Number = None
    jumps: int


class VehicleSummary(Published):
    """The figures of one vehicle."""

    system_id: int
    spacing_error_final_m: Number
    spacing_error_max_m: Number
    rtt_s: Estimate
    loop_delay_s: Estimate
    delay_margin_s: MarginRange = MarginRange(min=None, max=None)
    headroom_min: Number = None
    headroom_min_s: Number = None
    up_delay_s: OneWayDelay
    down_delay_s: OneWayDelay
    telemetry_age_s: Estimate
    station_queue_s: Estimate
    clock: Clock
    mode_final: str | None
    received: int | None
    lost: int | None
    late: int | None
    duplicate: int | None


class Control(Published):
    """Ticks flown and their punctuality."""

    rate_hz: float
    ticks: int
    deadline_misses: int
    lateness_s: Spread


class VehicleFlownSpread(Published):
    """The root mean square of one follower's spacing error: as reported, and predicted."""

    system_id: int
    reported_rms_m: Number
    predicted_rms_m: Number
    predicted_true_rms_m: Number


class FlownSpread(Published):
    """How far disturbances and navigation errors spread the spacing errors, as flown and as predicted."""

    loop_delay_s: Number
    from_s: Number
    vehicles: tuple[VehicleFlownSpread, ...] = ()


class LawRecord(Published):
    """The calls of the user's own control law."""

    calls: int
    unusable: int
    over_budget: int | None
    """None in virtual time, where calls are not timed."""
    budget_s: float


class Summary(Published):
    """The verdict on a run and its figures. Fields that an older file lacks keep their default.

    docs/reference describes each field.
    """

    scenario: str = ""
    verdict: str
    reason: str = ""
    fleet: str = STARTED
    not_logged: tuple[str, ...] = ()
    not_confirmed: str = ""
    loop: Literal["ground", "onboard"]
    prediction: float | str = "off"
    delay_margin_s: Number
    delay_margin_continuous_s: Number = None
    response: ResponsePart | None = None
    loop_delay_s: Spread
    loop_delay_bound_s: Number = None
    at_loop_delay: FiguresAtDelay = FiguresAtDelay(loop_delay_s=None)
    spread: FlownSpread | None = None
    headroom_min: Number
    headroom_end: float | None = None
    settling_time_s: float | None = None
    distance_min_m: Number = None
    duration_s: Number = None
    vehicles: tuple[VehicleSummary, ...] = ()
    control: Control | None = None
    """None if the log of the flight does not show the ticks."""
    refused: dict[str, int] = Field(default_factory=dict[str, int])
    mirror: dict[str, int] = Field(default_factory=dict[str, int])
    mode_changes: tuple[Annotated[Event, PlainSerializer(event_fields)], ...] = ()
    files: tuple[str, ...] = ()
    refused_by_vehicles: dict[str, int] | None = None
    margin_unknown: str = ""
    law: LawRecord | None = None
    code: tuple[CodeRecord, ...] = ()

    @property
    def spacing_error_final_m(self) -> float | None:
        """The largest of the vehicles' last spacing errors."""
        return max(
            (v.spacing_error_final_m for v in self.vehicles if v.spacing_error_final_m is not None), default=None
        )

    @property
    def spacing_error_max_m(self) -> float | None:
        """The largest spacing error of all vehicles."""
        return max((v.spacing_error_max_m for v in self.vehicles if v.spacing_error_max_m is not None), default=None)
