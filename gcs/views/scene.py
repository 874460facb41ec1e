"""Turns tick rows into points and lines in space. It makes arrays and text only; `recording` draws them."""

import colorsys
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.tick import Mode, TickArray
from gcs.plan.course import PlannedMotion
from gcs.plan.formation import plan_formation
from scenarios.schema import Scenario

Color = tuple[int, int, int]

PICTURE_S = 0.04
"""Least time between two pictures; 25 a second look smooth."""
TRAIL_STEP_S = 0.2
WIDTH, HEIGHT = 64, 16
_ASPECT = 2.0
"""Height to width of a character in the plan view."""

# Ten colours that are easy to tell apart on a dark background; more vehicles get hues around the colour circle.
PALETTE: tuple[Color, ...] = (
    (240, 240, 240), (66, 165, 245), (255, 167, 38), (102, 187, 106), (236, 90, 160),
    (255, 238, 88), (38, 198, 218), (171, 130, 255), (239, 83, 80), (174, 213, 129),
)  # fmt: skip

MODE_COLORS: dict[Mode, Color] = {
    Mode.NOMINAL: (56, 142, 60),
    Mode.RECOVERING: (38, 166, 154),
    Mode.CAUTION: (245, 166, 35),
    Mode.CRITICAL: (229, 57, 53),
    Mode.FAILSAFE: (171, 71, 188),
    Mode.LOST: (120, 20, 30),
    Mode.WAITING: (110, 110, 120),
}


def vehicle_colors(count: int) -> list[Color]:
    """One colour for each vehicle, in the scenario's order; the same in every view."""
    if count <= len(PALETTE):
        return list(PALETTE[:count])
    golden = (math.sqrt(5) - 1) / 2  # steps of the golden ratio keep each hue away from all earlier ones
    colors = (colorsys.hsv_to_rgb(k * golden % 1, 0.55 + 0.2 * (k % 2), 1.0) for k in range(count))
    return [(int(255 * red), int(255 * green), int(255 * blue)) for red, green, blue in colors]


@dataclass(frozen=True)
class Tree:
    """Who follows whom, as indices in the scenario's order."""

    leader: int
    followers: list[int]
    fronts: list[int]
    """For each follower, the vehicle that it follows."""
    offsets_m: FloatArray
    """For each follower, its place relative to that vehicle at the start of the flight: (followers, 3), NED."""
    places_m: Callable[[float], FloatArray] | None = None
    """The places (vehicles, 3) at a scenario time: north and east of the leader, local down; None if constant."""

    def offsets_at_m(self, times_s: FloatArray) -> FloatArray:
        """The offsets at these times: (times, followers, 3), or (followers, 3) if they never change."""
        if self.places_m is None:
            return self.offsets_m
        places_m = np.stack([self.places_m(time_s) for time_s in times_s.tolist()])
        return places_m[:, self.followers] - places_m[:, self.fronts]


def tree_of(scenario: Scenario) -> Tree:
    index = {vehicle.system_id: k for k, vehicle in enumerate(scenario.vehicles)}
    formation = plan_formation(scenario)
    rows = [formation.row(vehicle.system_id) for vehicle in scenario.vehicles]
    down_m = -np.array([[scenario.altitude_of(vehicle)] for vehicle in scenario.vehicles])

    def with_down(place_ne_m: FloatArray) -> FloatArray:
        return np.hstack([place_ne_m[rows], down_m])

    place_m = with_down(formation.place_ne_m())
    followers = [k for k, vehicle in enumerate(scenario.vehicles) if vehicle.follows is not None]
    fronts = [index[vehicle.follows] for vehicle in scenario.vehicles if vehicle.follows is not None]
    motion = PlannedMotion(scenario, formation) if scenario.manoeuvres else None
    return Tree(
        leader=rows.index(0),
        followers=followers,
        fronts=fronts,
        offsets_m=place_m[followers] - place_m[fronts],
        places_m=None if motion is None else lambda time_s: with_down(motion.places_ne_m(time_s)),
    )


class Newest:
    """Fills gaps in a time series: replaces NaN by the newest known value."""

    def __init__(self, *shape: int) -> None:
        self._last = np.full(shape, np.nan)

    def fill(self, values: FloatArray) -> FloatArray:
        """`values`, whose first axis is time, with gaps filled; NaN remains before the first known value."""
        filled = np.empty_like(values)
        for k, line in enumerate(values):
            filled[k] = self._last = np.where(np.isnan(line), self._last, line)
        return filled


class PictureTimes:
    """Picks times that are at least `step_s` apart from a stream of times."""

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._due_s = -np.inf

    def pick(self, times_s: FloatArray) -> Iterator[int]:
        for k, time_s in enumerate(times_s):
            if time_s >= self._due_s:
                self._due_s = time_s + self._step_s - 1e-6
                yield k


def positions_m(ticks: TickArray) -> FloatArray:
    """Positions (ticks, vehicles, 3), NED, all extrapolated to the instant of their tick.

    The states used by one tick were sampled at different instants; at 91 m/s the difference is several metres. A state
    of unknown age is not extrapolated.
    """
    sampled_m = np.stack([ticks["north_m"], ticks["east_m"], ticks["down_m"]], axis=2)
    axes = ("velocity_north_m_s", "velocity_east_m_s", "velocity_down_m_s")
    velocity_m_s = np.stack([ticks[axis] for axis in axes], axis=2)
    return sampled_m + np.nan_to_num(velocity_m_s * ticks["telemetry_age_s"][..., np.newaxis])


def plan_view(place_ne_m: Mapping[int, tuple[float, float]]) -> str:
    """The formation from above as text: system ids, north up. Of vehicles in the same cell, the first is shown."""
    north = [n for n, _ in place_ne_m.values()]
    east = [e for _, e in place_ne_m.values()]
    apart_m = min((math.hypot(a[0] - b[0], a[1] - b[1]) for a, b in combinations(place_ne_m.values(), 2)), default=1.0)
    cell_m = max((max(north) - min(north)) / (HEIGHT - 1), (max(east) - min(east)) / (WIDTH - 5) * _ASPECT)
    cell_m = max(cell_m, apart_m / 2.0)  # a few vehicles need no large picture
    rows = [[" "] * WIDTH for _ in range(round((max(north) - min(north)) / cell_m) + 1)]
    for system_id, (n, e) in place_ne_m.items():
        row, column = rows[round((max(north) - n) / cell_m)], round((e - min(east)) / cell_m * _ASPECT)
        text = str(system_id)
        if all(character == " " for character in row[column : column + len(text)]):
            row[column : column + len(text)] = text
    lines = ["".join(row).rstrip() for row in rows]
    return "\n".join(["north", *(f"  {line}" for line in lines), f"  ({cell_m:.3g} m a line)"])
