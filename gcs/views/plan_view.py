"""The formation seen from above, in characters."""

from collections.abc import Mapping
from itertools import combinations
from math import hypot

WIDTH, HEIGHT = 64, 16
_ASPECT = 2.0
"""A character is about twice as high as wide."""


def plan_view(place_ne_m: Mapping[int, tuple[float, float]]) -> str:
    """Each vehicle's system id at its place, north up, on one scale; of vehicles in one cell the first is shown."""
    north = [n for n, _ in place_ne_m.values()]
    east = [e for _, e in place_ne_m.values()]
    apart_m = min((hypot(a[0] - b[0], a[1] - b[1]) for a, b in combinations(place_ne_m.values(), 2)), default=1.0)
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
