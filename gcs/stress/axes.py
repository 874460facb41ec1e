"""The axes of a campaign: the quantities of a scenario that vary, and their values.

Here *link delay* is the sum of a vehicle's two links, up plus down. The loop delay is the link delay plus the wait of
telemetry for the next control tick, which is less than one period, so link delays compare directly with the margin.
The up link takes a whole number of control periods, as near to half as possible, and the down link takes the rest. The
loop delay then grows evenly with the link delay. With any other split the wait would jump by a period whenever the up
link crossed a whole period.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from gcs.errors import InputError
from scenarios.keys.link import Jitter, Link, VehicleLinks
from scenarios.keys.part import PREDICTION_MAX_S
from scenarios.link_files import each_link
from scenarios.schema import Scenario


@dataclass(frozen=True)
class Axis:
    """One quantity that varies. `name` is "delay", "jitter", "loss", "rate", "prediction", or "delay_<system id>"."""

    name: str
    values: tuple[float, ...]

    @property
    def label(self) -> str:
        if self.name.startswith("delay_"):
            return f"link delay of vehicle {self.name.removeprefix('delay_')}, up + down [s]"
        return _LABELS[self.name]


PREDICTION = "prediction"
_LABELS = {
    "delay": "link delay, up + down [s]",
    "jitter": "link jitter, each way [s]",
    "loss": "loss of datagrams, each way",
    "rate": "control and telemetry rate [Hz]",
    PREDICTION: "assumed loop delay [s], 0 without prediction",
}
_FORM = "FROM:TO:N"
_MOST = 10_000
"""Maximum number of values on an axis."""
_RANGES = {
    "delay": (0.0, 60.0, " s"),
    "jitter": (0.0, 10.0, " s"),
    "loss": (0.0, 1.0, ""),
    "rate": (1.0, 500.0, " Hz"),
    PREDICTION: (0.0, PREDICTION_MAX_S, " s"),
}
"""Smallest and largest value allowed on each axis, and its unit."""


def parse_axis(option: str, text: str, system_ids: tuple[int, ...] = ()) -> Axis:
    """Parse an option's text into an axis: FROM:TO:N, or values separated by commas.

    The text of --delay-of begins with the system id of a vehicle in `system_ids`: ID=FROM:TO:N. Raises InputError if
    the text has neither form, or a value is out of range.
    """
    name = option.removeprefix("--")
    low, high, unit = _RANGES[name.split("-", maxsplit=1)[0]]
    if name == "delay-of":
        system_id, equals, values_text = text.partition("=")
        if not equals or system_id not in map(str, system_ids):
            wanted = f"ID={_FORM} with the system id of a vehicle of this scenario"
            raise InputError(f"{option}: read {text!r}, wanted {wanted}")
        name, text = f"delay_{system_id}", values_text
    try:
        if ":" in text:
            first, last, count = text.split(":")
            ends, points = (float(first), float(last)), int(count)
            values = np.linspace(*ends, points).tolist() if np.isfinite(ends).all() and points <= _MOST else []
        else:
            values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    # rounded to what a user would write, so that ids do not depend on how a range was divided
    values = [round(value, 9) for value in values]
    if not values or not all(low <= value <= high for value in values):
        wanted = f"{_FORM} or a list such as 0.1,0.2, of at most {_MOST} values from {low:g} to {high:g}{unit}"
        raise InputError(f"{option}: read {text!r}, wanted {wanted}")
    return Axis(name, tuple(dict.fromkeys(values)))


def at_coordinates(scenario: Scenario, coordinates: dict[str, float]) -> Scenario:
    """The scenario at one point of a campaign.

    A rate sets the control rate, and the telemetry rate too if the two were equal; rates on board scale in proportion.
    Jitter keeps the distribution of a link that has one; on other links it is uniform within ± the value. Losses are
    independent and replace bursts. Raises InputError for jitter on a link with a trace of delays, which has no scale.
    """
    if "rate" in coordinates:
        scenario = _with_rate(scenario, coordinates["rate"])
    if PREDICTION in coordinates:
        scenario = scenario.with_keys(control={"prediction": coordinates[PREDICTION] or "off"})
    if "delay" in coordinates:
        up_s, down_s = split_delay(coordinates["delay"], 1.0 / scenario.rates.control_hz)
        scenario = scenario.with_link_delay(up_s=up_s, down_s=down_s)
    for name, delay_s in coordinates.items():
        if name.startswith("delay_"):
            scenario = _with_vehicle_delay(scenario, int(name.removeprefix("delay_")), delay_s)
    if "jitter" in coordinates:
        change = partial(_with_jitter, scale_s=coordinates["jitter"])
        scenario = scenario.with_links(change, change)
    if "loss" in coordinates:
        lossy = partial(Link.model_copy, update={"loss_probability": coordinates["loss"], "loss_bursts": None})
        scenario = scenario.with_links(lossy, lossy)
    return scenario


def has_constant_links(scenario: Scenario) -> bool:
    """Whether every link has only a constant delay, so that the models describe it exactly."""
    return all(link == Link(delay_s=link.delay_s) for _, link in each_link(scenario.links))


def place_text(coordinates: Mapping[str, float]) -> str:
    """The values on the axes with their units.

    >>> place_text({"delay_2": 0.3, "loss": 0.1})
    'delay of vehicle 2 0.3 s, loss 0.1'
    """
    units = {name: _RANGES[name.split("_", maxsplit=1)[0]][2] for name in coordinates}
    return ", ".join(
        f"{name.replace('_', ' of vehicle ')} {value:g}{units[name]}" for name, value in coordinates.items()
    )


def split_delay(total_s: float, period_s: float) -> tuple[float, float]:
    """Split a total link delay into about half up, a whole number of periods, and the rest down."""
    up_s = round(round(total_s / 2.0 / period_s) * period_s, 12)
    return up_s, max(0.0, round(total_s - up_s, 12))


def _with_rate(scenario: Scenario, hz: float) -> Scenario:
    rates = scenario.rates
    same = rates.telemetry_hz == rates.control_hz
    return scenario.at_rates(control_hz=hz, telemetry_hz=hz if same else rates.telemetry_hz)


def _with_jitter(link: Link, scale_s: float) -> Link:
    if link.jitter is not None and link.jitter.distribution == "trace":
        raise InputError("--jitter: read links with a trace of measured delays, wanted jitter with a scale, or none")
    if scale_s == 0.0:
        return link.model_copy(update={"jitter": None})
    if link.jitter is not None:
        return link.model_copy(update={"jitter": link.jitter.model_copy(update={"scale_s": scale_s})})
    return link.model_copy(update={"jitter": Jitter(distribution="uniform", scale_s=scale_s)})


def _with_vehicle_delay(scenario: Scenario, system_id: int, delay_s: float) -> Scenario:
    delays_s = split_delay(delay_s, 1.0 / scenario.rates.control_hz)
    links = zip(scenario.link_of(system_id), delays_s, strict=True)
    up, down = (link.model_copy(update={"delay_s": own_s, "delay_points": ()}) for link, own_s in links)
    own = VehicleLinks(system_id=system_id, up=up, down=down)
    others = tuple(links for links in scenario.links.vehicles if links.system_id != system_id)
    return scenario.with_keys(links={"vehicles": (*others, own)})
