"""The state at the instant at which a command acts, from a sample and from the commands that act in between."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from gains.core.arrays import FloatArray


class LiftedPlant(Protocol):
    """The plant under held commands: linear, and the same in every common period."""

    @property
    def K(self) -> FloatArray: ...  # noqa: N802 - the source's letter

    def between(self, instants: Sequence[float]) -> tuple[FloatArray, FloatArray]:
        """From each instant to the next: maps of the state (k, n, n), and of an input held since then (k, n, r)."""
        ...


@dataclass(frozen=True, eq=False)
class Predictor:
    """The plant that is believed, and the (mean) loop delay (s) over which it is predicted."""

    believed: LiftedPlant
    assumed_s: float

    def predicted(
        self, x: FloatArray, given: Mapping[int, FloatArray], acting_s: Sequence[float], *, taken_s: float, first: int
    ) -> FloatArray:
        """The state at the last of `acting_s`, from its value x at `taken_s`.

        Commands act at the instants `acting_s`, ascending. They are `given`, numbered from `first` on.
        """
        held = bisect_right(acting_s, taken_s) - 1
        instants = [taken_s, *acting_s[held + 1 :]]
        if instants[-1] > taken_s:
            numbers = range(first + held, first + len(acting_s) - 1)
            for number, Phi, hold in zip(numbers, *self.believed.between(instants), strict=True):
                x = Phi @ x + hold @ given[number]
        return x
