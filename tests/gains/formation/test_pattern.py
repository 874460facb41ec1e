"""Information patterns: which output each input may use."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.core.errors import BadModelError
from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gains.formation.pattern import (
    Pattern,
    Plant,
    all_to_all,
    bidirectional,
    check_fits,
    checked_pattern_gain,
    formation_plant,
    leader_follower,
    with_links,
    without_links,
)
from gains.sampled.onboard import own_part

# The gains printed in chapter 5 of the source, with the misprint in k33 ("0.5003") corrected.
K11 = np.array([[-18.0874, 0.0005], [0.0005, -18.0874]])
K12 = np.array([[-17.2478, -0.0013, 1.9965, -0.0013], [-0.0013, -17.2478, -0.0013, 1.9965]])
K21 = np.array([[-6.0567, 0.0053], [0.0053, -6.0567]])
K22 = np.array([[2.0180, 0.0015, -17.0089, -0.0005], [0.0015, 2.0180, -0.0005, -17.0089]])
K23 = np.array([[-7.6645, 0.0002, -0.5902, -0.0006], [0.0002, -7.6645, -0.0006, -0.5902]])
K32 = np.array([[5.7726, -0.0002, -2.6051, 0.0036], [-0.0002, 5.7726, 0.0036, -2.6051]])
K33 = np.array([[10.5003, 0.0008, -17.0949, 0.0012], [0.0008, 10.5003, 0.0012, -17.0949]])
PRINTED = np.block([[K11, K12, np.zeros((2, 4))], [K21, K22, K23], [np.zeros((2, 2)), K32, K33]])

CHAIN = FormationModel((-1, 0, 1))


@st.composite
def trees(draw: st.DrawFn) -> FormationModel:
    size = draw(st.integers(1, 7))
    return FormationModel((-1, *(draw(st.integers(0, i - 1)) for i in range(1, size))), axes=draw(st.integers(1, 3)))


def test_chapter_5_pattern_of_three_vehicles_is_the_bidirectional_chain() -> None:
    pattern = bidirectional(CHAIN)
    assert pattern.blocks.astype(int).tolist() == [[1, 1, 0], [1, 1, 1], [0, 1, 1]]
    assert (pattern.input_sizes, pattern.output_sizes) == ((2, 2, 2), (2, 4, 4))


def test_printed_gains_have_known_margins_with_prompt_and_late_feedback() -> None:
    # both recomputed for this project by two methods; the source prints 0.19 s for the former, which no split gives
    plant = formation_plant(CHAIN)
    own = own_part(CHAIN, PRINTED)
    others = PRINTED - own
    # the figures have 6 and 5 digits
    assert delay_margin(plant.closed_loop(own), plant.B @ others) == pytest.approx(1.00796, rel=5e-6)
    assert delay_margin(plant.A, plant.B @ PRINTED) == pytest.approx(0.077736, rel=1e-5)


def test_own_part_is_the_blocks_on_the_diagonal() -> None:
    own = own_part(CHAIN, PRINTED)
    assert np.array_equal(own[2:4, 2:6], K22)
    assert not own[2:4, :2].any()
    assert not (PRINTED - own)[4:, 6:].any()


@given(trees())
def test_overlapping_gain_of_any_tree_has_the_leader_follower_pattern(formation: FormationModel) -> None:
    gain = np.ones((formation.axes, formation.axes))
    pattern = leader_follower(formation)
    K = formation.overlapping_gain(-gain, gain, gain)
    assert np.array_equal(checked_pattern_gain(pattern, K), K)
    assert len(pattern.links) == 2 * formation.vehicles - 1
    check_fits(formation_plant(formation), pattern)


def test_several_predecessors_and_backward_links_are_added_and_taken_away() -> None:
    pattern = leader_follower(FormationModel((-1, 0, 1, 2)))
    more = with_links(pattern, [(3, 1), (0, 3)])
    assert set(more.links) - set(pattern.links) == {(3, 1), (0, 3)}
    assert without_links(more, [(3, 1), (0, 3)]).links == pattern.links
    # u_3 is rows 6 and 7, y_1 columns 2 to 5
    assert more.mask[6:8, 2:6].all()
    assert not pattern.mask[6:8, 2:6].any()


def test_a_gain_outside_the_pattern_is_refused_with_its_block() -> None:
    K = np.zeros((6, 10))
    K[5, 1] = 3.0
    with pytest.raises(BadModelError, match=r"K\[5, 1\] = 3.0, in block \(2, 0\)"):
        checked_pattern_gain(bidirectional(CHAIN), K)
    checked_pattern_gain(all_to_all(CHAIN), K)
    with pytest.raises(BadModelError, match=r"shape \(6, 9\); \(6, 10\) is wanted"):
        checked_pattern_gain(bidirectional(CHAIN), np.zeros((6, 9)))


def test_patterns_and_plants_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BadModelError, match="entries other than 0 and 1"):
        Pattern(np.array([[1, 2]]), (1,), (1, 1))
    with pytest.raises(BadModelError, match=r"output_sizes = \(1,\) has 1 entries; 2"):
        Pattern(np.array([[1, 1]]), (1,), (1,))
    with pytest.raises(BadModelError, match=r"input_sizes = \(0,\)"):
        Pattern(np.array([[1, 1]]), (0,), (1, 1))
    with pytest.raises(BadModelError, match=r"link \(3, 0\)"):
        with_links(leader_follower(CHAIN), [(3, 0)])
    with pytest.raises(BadModelError, match="B has shape"):
        Plant(np.eye(2), np.eye(3))
    with pytest.raises(BadModelError, match="C has shape"):
        Plant(np.eye(2), np.eye(2), np.eye(3))
    with pytest.raises(BadModelError, match="the pattern has 6 inputs and 10 outputs; 6 and 2 are wanted"):
        check_fits(formation_plant(CHAIN, np.eye(10)[:2]), leader_follower(CHAIN))
