"""Modes and phases as tables."""

from itertools import product

import pytest

from gcs.modes import END_PATIENCE_S, Phase, next_phase, vehicle_mode
from gcs.record import Mode

NAN = float("nan")


@pytest.mark.parametrize(
    ("flying", "silent", "guided", "failsafe", "headroom", "mode"),
    [
        (False, False, False, False, NAN, Mode.WAITING),
        (False, True, True, False, -1.0, Mode.WAITING),
        (False, False, False, True, 0.5, Mode.FAILSAFE),
        (True, True, True, False, 0.5, Mode.LOST),
        (True, True, False, True, -0.5, Mode.LOST),
        (True, False, False, False, 0.5, Mode.FAILSAFE),
        (True, False, False, True, -0.5, Mode.FAILSAFE),
        (True, False, True, False, -0.001, Mode.CRITICAL),
        (True, False, True, False, 0.0, Mode.CAUTION),
        (True, False, True, False, 0.249, Mode.CAUTION),
        (True, False, True, False, 0.25, Mode.NOMINAL),
        (True, False, True, False, NAN, Mode.NOMINAL),
    ],
)
def test_vehicle_mode(flying: bool, silent: bool, guided: bool, failsafe: bool, headroom: float, mode: Mode) -> None:
    got = vehicle_mode(flying=flying, silent=silent, guided=guided, failsafe=failsafe, headroom=headroom)
    assert got is mode


def test_phases_follow_each_other_in_one_order_only() -> None:
    order = list(Phase)
    flags = product((False, True), repeat=3)
    for phase, (ready, stop, holding), waited_s in product(order, list(flags), (0.0, END_PATIENCE_S + 1)):
        after = next_phase(phase, all_ready=ready, stop=stop, all_holding=holding, waited_s=waited_s)
        assert order.index(after) - order.index(phase) in {0, 1, 2}
        if stop and phase in {Phase.CONNECTING, Phase.FLYING}:
            assert after is Phase.ENDING
        elif phase is Phase.CONNECTING:
            assert after is (Phase.FLYING if ready else Phase.CONNECTING)
        elif phase is Phase.FLYING:
            assert after is Phase.FLYING
        elif phase is Phase.ENDING:
            assert after is (Phase.ENDED if holding or waited_s > END_PATIENCE_S else Phase.ENDING)
        else:
            assert after is Phase.ENDED
