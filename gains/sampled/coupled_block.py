"""Blocks of vehicles that act on each other: the margin of each block and its growth at any loop delay.

The states of a formation form blocks that do not act on the blocks ahead of them: in a leader-follower tree every
vehicle is a block of its own. The formation is stable exactly if every block is, each at its own loop delay.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite

import numpy as np
from numpy.linalg import pinv

from gains.core.arrays import FloatArray
from gains.core.errors import DisagreementError
from gains.delay._mixed import count_unstable_roots
from gains.delay.constant import delay_margin
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.sampled._extrapolated import ExtrapolatedLoop, extrapolated_loop
from gains.sampled._loop import HeldPlant
from gains.sampled.multirate import Timing, multirate_delay_margin, multirate_growth_rate
from gains.sampled.onboard import OnboardLoop, OnboardTiming, onboard_loop, streamed_loop
from gains.sampled.prediction import checked_mask, mismatch_window, mismatch_window_continuous, predicted_growth_rate

_SHIFT_1_S = 1e-6
"""Roots right of this are unstable; the root at zero of the formation's position, which is uncontrolled, is not."""


@dataclass(frozen=True, eq=False)
class CoupledBlock:
    """Vehicles that act on each other, with their part of e' = A e + B u, u = K e; all have the same axes.

    `system_ids` names the vehicles. `onboard` is the loop closed on board, None if the station closes every loop: all
    feedback is then late. `assumed_s` is the loop delay over which the station predicts, None without prediction, and
    `measured` is as in `gains.sampled.prediction`. `extrapolated` is the same loop with states of different ages, for
    vehicles that share a loop that the station closes without prediction.
    """

    system_ids: tuple[int, ...]
    A: FloatArray
    B: FloatArray
    K: FloatArray
    timing: Timing
    onboard: OnboardLoop | None = None
    assumed_s: float | None = None
    measured: Sequence[bool] | None = None
    extrapolated: ExtrapolatedLoop | None = None

    @property
    def has_late_terms(self) -> bool:
        """Whether any feedback inside the block is late; a single vehicle in the onboard loop has none."""
        return bool(self._continuous_terms()[1].any())

    def margin_s(self) -> float:
        """The loop delay (s) at which the sampled and held loop loses stability: the upper end of its window."""
        return self.window_s()[1]

    def window_s(self) -> tuple[float, float]:
        """The loop delays (s) between which the sampled and held loop is stable; starts at 0 without prediction."""
        if self.onboard is not None:
            return 0.0, self.onboard.sampled_margin_s()
        loop = self.A, self.B, self.K, self.timing
        if self.assumed_s is None:
            return 0.0, multirate_delay_margin(*loop)
        return mismatch_window(*loop, assumed_s=self.assumed_s, measured=self.measured)

    def window_continuous_s(self) -> tuple[float, float]:
        """The same window for the continuous model; the hold counts as half a period."""
        half_s = self.timing.held_s / 2.0
        if self.onboard is not None:
            return 0.0, self.onboard.continuous_margin_s() - half_s
        if self.assumed_s is None:
            return 0.0, delay_margin(self.A, self.B @ self.K) - half_s
        loop, assumed_s = (self.A, self.B, self.K), self.assumed_s + half_s
        least_s, most_s = mismatch_window_continuous(*loop, assumed_s=assumed_s, measured=self.measured)
        return max(0.0, least_s - half_s), most_s - half_s

    def growth_1_s(self, delay_s: float) -> float:
        """Growth rate (1/s) of the sampled and held loop at a loop delay."""
        if self.onboard is not None:
            return self.onboard.growth_1_s(delay_s)
        loop = self.A, self.B, self.K, self.timing
        if self.assumed_s is None:
            return multirate_growth_rate(*loop, delay_s=delay_s)
        return predicted_growth_rate(*loop, assumed_s=self.assumed_s, delay_s=delay_s, measured=self.measured)

    def growth_continuous_1_s(self, delay_s: float) -> float:
        """Real part (1/s) of the rightmost root of the continuous model; the hold counts as half a period of delay."""
        return self.growth_continuous_at_1_s(dict.fromkeys(self.system_ids, delay_s))

    def growth_continuous_at_1_s(
        self, loop_delay_s: Mapping[int, float], age_s: Mapping[int, float] | None = None
    ) -> float:
        """`growth_continuous_1_s` with a separate loop delay for each vehicle's command.

        `age_s` holds the age of each vehicle's state when the station uses it. Without it, all states that a command
        uses are taken to be sampled at one instant.
        """
        delays_s = [loop_delay_s[system_id] + self.timing.held_s / 2.0 for system_id in self.system_ids]
        if age_s is not None and self.extrapolated is not None:
            return self.extrapolated.growth_1_s(delays_s, [age_s[system_id] for system_id in self.system_ids])
        return rightmost_root(self._terms(delays_s)).real

    def is_stable_at(self, loop_delay_s: Mapping[int, float], age_s: Mapping[int, float] | None = None) -> bool:
        """Whether the sampled loop is stable if each vehicle has its own loop delay.

        Decided by the continuous model, with the hold counted as the delay that gives equal links the margin of the
        sampled loop. Over long links, growth takes a thousand times as long. `age_s` as for `growth_continuous_at_1_s`.
        """
        delays_s = [loop_delay_s[system_id] + self._hold_s for system_id in self.system_ids]
        if age_s is not None and self.extrapolated is not None:
            terms = self.extrapolated.terms(delays_s, [age_s[system_id] for system_id in self.system_ids])
        else:
            terms = self._terms(delays_s)
        shifted = [(np.exp(_SHIFT_1_S * delay_s) * A, delay_s) for A, delay_s in terms]
        shifted.append((-_SHIFT_1_S * np.eye(len(terms[0][0])), 0.0))
        try:
            return count_unstable_roots(shifted) == 0
        except DisagreementError:  # on the stability boundary
            return False

    @cached_property
    def _hold_s(self) -> float:
        """The delay (s) that stands for the hold: with it the continuous model has the sampled margin."""
        continuous_s, sampled_s = self.window_continuous_s()[1], self.margin_s()
        shorter_s = continuous_s - sampled_s if isfinite(continuous_s - sampled_s) else 0.0
        return self.timing.held_s / 2.0 + shorter_s

    def _continuous_terms(self) -> tuple[list[tuple[FloatArray, float]], FloatArray]:
        """The continuous model: pairs (matrix, known delay in s), and the matrix that acts a loop delay late."""
        if self.onboard is not None:
            return self.onboard.continuous_terms()
        if self.assumed_s is None:
            return [(self.A, 0.0)], self.B @ self.K
        assumed_s, loop = self.assumed_s + self.timing.held_s / 2.0, (self.A, self.B, self.K)
        plant = HeldPlant(*loop, self.timing.held_s, checked_mask(loop, self.measured))
        late = self.B @ (self.K @ plant.carry(np.array([assumed_s]))[0])
        return [(self.A + self.B @ self.K, 0.0), (-late, assumed_s)], late

    def _terms(self, delays_s: Sequence[float]) -> list[tuple[FloatArray, float]]:
        """Pairs (A, d) of the continuous model with a delay (s) for the command of each vehicle."""
        known, late = self._continuous_terms()
        entries, commands = (
            np.split(part, len(delays_s), axis) for part, axis in ((self.B, 1), (pinv(self.B) @ late, 0))
        )
        own = [B @ command for B, command in zip(entries, commands, strict=True)]
        return [*known, *zip(own, delays_s, strict=True)]

    def growth_at_1_s(self, loop_delay_s: Mapping[int, float], age_s: Mapping[int, float] | None = None) -> float:
        """Growth rate (1/s) of the sampled loop if each vehicle has its own loop delay.

        Exact if delays and ages are equal. Otherwise the rate at the mean delay, plus the change that the differences
        make in the continuous model. `age_s` as for `growth_continuous_at_1_s`.
        """
        delays_s = [loop_delay_s[system_id] for system_id in self.system_ids]
        ages_s = {(age_s or {}).get(system_id) for system_id in self.system_ids}
        mean_s = sum(delays_s) / len(delays_s)
        rate_1_s = self.growth_1_s(mean_s)
        if max(delays_s) == min(delays_s) and len(ages_s) == 1:
            return rate_1_s
        differing_1_s = self.growth_continuous_at_1_s(loop_delay_s, age_s)
        return rate_1_s + differing_1_s - self.growth_continuous_1_s(mean_s)

    @property
    def kind(self) -> Hashable:
        """Key that is equal for blocks of different vehicles that are the same system."""
        return self.timing, self.assumed_s, *((part.shape, (part + 0.0).tobytes()) for part in (self.A, self.B, self.K))


def coupled_blocks(
    model: FormationModel,
    K: FloatArray,
    system_ids: Sequence[int],
    *,
    timing: Timing,
    onboard: OnboardTiming | None = None,
    assumed_s: float | None = None,
    responding: tuple[FloatArray, FloatArray, FloatArray] | None = None,
    response_states: Sequence[slice] = (),
) -> list[CoupledBlock]:
    """The blocks of a formation flown with the gain K (inputs, states) of u = K e, those ahead first.

    `system_ids` holds one ID per vehicle, in the order of `model`. `onboard` is the timing of the onboard loop; without
    it, the station closes every loop. It predicts over `assumed_s` if that is given. `responding` is A, B and K of the
    formation with the vehicles' responses, and `response_states` are the slices of its states that belong to each
    vehicle's response (`gains.performance.response`); without them the vehicles respond at once.

    In a chain of three, each vehicle is a block and the two followers are alike. Sampling at 50 Hz costs half a period:

    >>> chain = FormationModel((-1, 0, 1))
    >>> K = chain.overlapping_gain(-np.eye(2), 0 * np.eye(2), np.eye(2))
    >>> blocks = coupled_blocks(chain, K, (1, 2, 3), timing=Timing(control_s=0.02, telemetry_s=0.02))
    >>> [(block.system_ids, round(block.margin_s(), 3)) for block in blocks]
    [((1,), 1.561), ((2,), 0.701), ((3,), 0.701)]
    """
    whole = None if onboard is None or assumed_s is not None else onboard_loop(model, K, onboard)
    streamed = streamed_loop(model, K, onboard) if onboard is not None and assumed_s is not None else responding
    A, B, gain = streamed or (model.A, model.B, K)
    blocks: list[CoupledBlock] = []
    for members in model.coupled_vehicles(K):
        errors = np.concatenate([np.r_[model.output_slice(i)] for i in members])
        own = np.concatenate([errors, *(np.r_[response_states[i]] for i in members if response_states)])
        inputs = np.concatenate([np.r_[model.input_slice(i)] for i in members])
        matrices = A[np.ix_(own, own)], B[np.ix_(own, inputs)], gain[np.ix_(inputs, own)]
        by_station = whole is None and assumed_s is None
        block = CoupledBlock(
            tuple(system_ids[i] for i in members),
            *matrices,
            timing,
            None if whole is None else whole.part(own),
            assumed_s,
            None if assumed_s is None else [state < model.states for state in own.tolist()],
            extrapolated_loop(model, members, *matrices) if len(members) > 1 and by_station else None,
        )
        blocks.append(block)
    return blocks


def first_of_each_kind(blocks: Sequence[CoupledBlock]) -> list[CoupledBlock]:
    """The first block of each kind."""
    return list({block.kind: block for block in reversed(blocks)}.values())[::-1]


def critical_block(
    blocks: Sequence[CoupledBlock], loop_delay_s: Mapping[int, float], age_s: Mapping[int, float] | None = None
) -> CoupledBlock:
    """The block with the largest predicted growth (1/s) at the loop delays (s) of its vehicles; the first in a tie.

    `age_s` as for `CoupledBlock.growth_at_1_s`.
    """
    known: dict[Hashable, float] = {}
    ages_s = age_s or {}

    def growth_1_s(block: CoupledBlock) -> float:
        both = ((loop_delay_s[own], ages_s.get(own, 0.0)) for own in block.system_ids)
        key = block.kind, *((round(delay, 9), round(age, 9)) for delay, age in both)
        if key not in known:
            known[key] = block.growth_at_1_s(loop_delay_s, age_s)
        return known[key]

    return max(blocks, key=growth_1_s)
