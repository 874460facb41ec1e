"""The phases of a flight as a table."""

from itertools import product

from gcs.control.phases import END_PATIENCE_S, Phase, next_phase


def test_phases_follow_each_other_in_one_order_only() -> None:
    order = list(Phase)
    flags = product((False, True), repeat=4)
    for phase, (ready, stop, holding, identified), waited_s in product(order, list(flags), (0.0, END_PATIENCE_S + 1)):
        after = next_phase(
            phase, all_ready=ready, stop=stop, all_holding=holding, waited_s=waited_s, identified=identified
        )
        assert order.index(after) >= order.index(phase)
        if stop and phase in {Phase.CONNECTING, Phase.IDENTIFYING, Phase.FLYING}:
            assert after is Phase.ENDING
        elif phase is Phase.CONNECTING:
            begun = Phase.FLYING if identified else Phase.IDENTIFYING
            assert after is (begun if ready else Phase.CONNECTING)
        elif phase is Phase.IDENTIFYING:
            assert after is (Phase.FLYING if identified else Phase.IDENTIFYING)
        elif phase is Phase.FLYING:
            assert after is Phase.FLYING
        elif phase is Phase.ENDING:
            assert after is (Phase.ENDED if holding or waited_s > END_PATIENCE_S else Phase.ENDING)
        else:
            assert after is Phase.ENDED
