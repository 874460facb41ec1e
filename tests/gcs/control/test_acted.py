"""Reports of the active target correct the history of set-points to what the vehicle did."""

from collections import Counter
from itertools import product
from typing import Any

import numpy as np
import pytest

from gains.performance.response import Response
from gcs.control.acted import ActiveTargets
from gcs.control.prediction import CommandHistory, LaglessMotion
from gcs.control.responding import Responding
from gcs.link import mavlink

MS, S = 1_000_000, 1_000_000_000
START, PERIOD, DOWN = 10 * S, 100 * MS, 250 * MS
Vector = tuple[float, float]


def active(acceleration: Vector, velocity: Vector | None = None) -> tuple[Any, ...]:
    """Fields of POSITION_TARGET_LOCAL_NED after a trip over the link; the mask says whether it has a velocity."""
    north, east = velocity or (0.0, 0.0)
    mask = 0x0C3F if velocity is None else 0x0C07
    fields = (0, 0.0, 0.0, 0.0, north, east, 0.0, *acceleration, 0.0, 0.0, 0.0, mask, 1)
    [frame] = mavlink.decode(mavlink.encode(mavlink.POSITION_TARGET_LOCAL_NED, fields, sequence=0), Counter())
    return frame.fields


class Link:
    """A vehicle that takes some set-points and reports what it follows, and the station's history of set-points."""

    def __init__(self, count: int = 20, *, responds: LaglessMotion | None = None) -> None:
        self.wanted = np.random.default_rng(1).uniform(-5.0, 5.0, (count, 2))
        self.history = CommandHistory(S, responds)
        self.targets = ActiveTargets(self.history, period_ns=PERIOD, held_ns=S)
        for k, (north, east) in enumerate(self.wanted.tolist()):
            self.history.add(START + k * PERIOD, (north, east))
            self.targets.sent(START + k * PERIOD, (east, north), (north, east))

    def report(self, tick: int, fields: tuple[Any, ...]) -> None:
        """A report sent 30 ms after the set-point of a tick should have acted."""
        self.targets.reported(START + tick * PERIOD + DOWN + 30 * MS, fields)

    def of(self, tick: int) -> tuple[Vector, Vector]:
        north, east = self.wanted[tick].tolist()
        return (north, east), (east, north)

    def gained_m_s(self, tick: int) -> complex:
        """The change of velocity that the history holds for one set-point."""
        begin, end = (self.history.sums(START + k * PERIOD)[0] for k in (tick, tick + 1))
        return (end - begin) / (PERIOD * 1e-9)

    def wanted_m_s2(self, tick: int) -> complex:
        return complex(*self.wanted[tick])


@pytest.mark.parametrize("responds", [LaglessMotion(), Responding(Response(0.3, 0.0))])
def test_an_altered_history_equals_that_of_what_acted(responds: LaglessMotion) -> None:
    """Without a velocity loop, the sums are those of a history in which the other set-point was sent."""
    altered, plain = CommandHistory(S, responds), CommandHistory(S, responds)
    for k in range(30):
        u = complex(np.sin(k), np.cos(k))
        other = 2.0 - 1.0j if k in (7, 8, 20) else 0j
        altered.add(START + k * PERIOD, (u.real, u.imag))
        plain.add(START + k * PERIOD, ((u + other).real, (u + other).imag))
    for k in (20, 7, 8):
        altered.alter(START + k * PERIOD, 2.0 - 1.0j)
    altered.alter(START + 1, 5.0)  # none is due then
    for after_ms in (750, 1230, 2999, 3500):
        assert altered.sums(START + after_ms * MS) == pytest.approx(plain.sums(START + after_ms * MS), abs=1e-9)


def test_a_velocity_loop_makes_up_for_what_was_lost() -> None:
    """After the next set-point it follows the same velocity target; a vehicle without such a loop does not."""
    for responds, left in ((Responding(Response(0.15, 2.0)), 0.0), (LaglessMotion(), 0.3)):
        altered, plain = CommandHistory(100 * S, responds), CommandHistory(100 * S, responds)
        for k in range(10):
            for history in (altered, plain):
                history.add(START + k * PERIOD, (0.1 * k, 0.0))
        altered.alter(START + 4 * PERIOD, 1.0)
        altered.alter(START + 5 * PERIOD, 2.0)
        late_ns = START + 30 * S
        assert altered.sums(late_ns)[0] - plain.sums(late_ns)[0] == pytest.approx(left, abs=1e-6)


def test_a_lost_set_point_is_replaced_by_the_one_held() -> None:
    link = Link()
    for tick, held in ((3, 3), (4, 4), (5, 4), (6, 4), (7, 7)):
        link.report(tick, active(link.of(held)[0]))
    for tick, acted in ((3, 3), (4, 4), (5, 4), (6, 4), (7, 7), (8, 8)):
        assert link.gained_m_s(tick) == pytest.approx(link.wanted_m_s2(acted), abs=1e-6)


def test_a_late_set_point_is_restored_when_it_acts() -> None:
    link = Link()
    for tick, held in ((3, 3), (4, 3)):
        link.report(tick, active(link.of(held)[0]))
    assert link.gained_m_s(4) == pytest.approx(link.wanted_m_s2(3), abs=1e-6)
    link.report(5, active(link.of(4)[0]))
    assert link.gained_m_s(4) == pytest.approx(link.wanted_m_s2(4), abs=1e-6)


def test_a_delivery_longer_than_assumed_is_not_loss() -> None:
    """The certificate counts it as delay mismatch; nothing here knows the assumed delay."""
    link = Link()
    for tick in range(8, 19):
        link.report(tick, active(link.of(tick - 6)[0]))
    assert all(link.gained_m_s(k) == pytest.approx(link.wanted_m_s2(k), abs=1e-9) for k in range(19))


def test_set_points_are_recognised_by_what_autopilots_leave_unchanged() -> None:
    """ArduPilot has integrated its velocity and rounds its acceleration to float32 in cm; PX4's is of its own loop."""
    ardupilot, px4 = Link(), Link()
    for tick, held in ((3, 3), (4, 4), (5, 4), (6, 4), (7, 7), (8, 7)):
        acceleration, velocity = ardupilot.of(held)
        in_cm = np.array(acceleration, np.float32) * np.float32(100.0)
        north, east = (in_cm * np.float32(0.01)).tolist()
        ardupilot.report(tick, active((north, east), (velocity[0] + 0.1, velocity[1] - 0.2)))
        px4.report(tick, active((acceleration[0] + 0.7, acceleration[1]), velocity))
    for link, (tick, held) in product((ardupilot, px4), ((5, 4), (6, 4), (8, 7))):
        assert link.gained_m_s(tick) == pytest.approx(link.wanted_m_s2(held), abs=1e-6)


def test_an_autopilots_own_target_changes_nothing() -> None:
    link = Link()
    link.report(3, active(*link.of(3)))
    link.report(4, active((9.0, 9.0), (9.0, 9.0)))
    assert link.gained_m_s(4) == pytest.approx(link.wanted_m_s2(4), abs=1e-9)


def test_set_points_under_way_are_clipped_like_the_last_one() -> None:
    link = Link()
    link.report(3, active(link.of(3)[0]))
    clipped = 1.0 * link.wanted_m_s2(4) / abs(link.wanted_m_s2(4))
    link.report(4, active((clipped.real, clipped.imag)))
    for tick in range(4, 19):
        size = min(1.0, abs(link.wanted_m_s2(tick)))
        assert link.gained_m_s(tick) == pytest.approx(
            size * link.wanted_m_s2(tick) / abs(link.wanted_m_s2(tick)), abs=1e-6
        )
    link.report(5, active(link.of(5)[0]))  # it can do more now
    assert link.gained_m_s(9) == pytest.approx(link.wanted_m_s2(9), abs=1e-6)


def test_a_speed_limit_changes_no_set_points_under_way() -> None:
    """It removes the part along the velocity, so that the rest has another direction than the set-point."""
    link = Link()
    link.report(3, active(link.of(3)[0]))
    aside = 0.01j * link.wanted_m_s2(4)
    link.report(4, active((aside.real, aside.imag)))
    assert link.gained_m_s(4) == pytest.approx(aside, abs=1e-6)
    for tick in range(5, 19):
        assert link.gained_m_s(tick) == pytest.approx(link.wanted_m_s2(tick), abs=1e-6)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0])
def test_no_reported_number_spoils_the_history(value: float) -> None:
    link = Link()
    link.report(3, active(link.of(3)[0]))
    link.report(4, active((value, value)))
    assert np.isfinite(link.gained_m_s(4))
    assert link.gained_m_s(9) == pytest.approx(link.wanted_m_s2(9), abs=1e-9)


def test_zeros_of_a_vehicle_at_rest_are_no_set_point() -> None:
    """The zeros it reports are its own, not the set-point of zero sent just before."""
    history = CommandHistory(S)
    targets = ActiveTargets(history, period_ns=PERIOD, held_ns=S)
    for k, north in enumerate((0.0, 3.0, 4.0, 5.0)):
        history.add(START + k * PERIOD, (north, 0.0))
        targets.sent(START + k * PERIOD, (0.0, 0.0), (north, 0.0))
        targets.reported(START + k * PERIOD + 10 * MS, active((0.0, 0.0)))
    assert history.sums(START + 4 * PERIOD)[0] == pytest.approx(0.1 * 12.0)
