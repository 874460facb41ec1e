"""Parameters for a vehicle: whatever the link does to them, done means that the vehicle has them."""

import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs.link import mavlink
from gcs.link.upload import ATTEMPTS, Upload, float32

MS = 1_000_000
NUMBERS = {"FORM_A": -17.0089, "FORM_B": 0.1, "FORM_C": 1.0}


class Holder:
    """A vehicle that takes and gives parameters as the protocol says."""

    def __init__(self) -> None:
        self.values = dict.fromkeys(NUMBERS, 0.0)

    def answer(self, msg_id: int, fields: tuple[Any, ...]) -> tuple[object, ...]:
        name = bytes(fields[3]).decode()
        if msg_id == mavlink.PARAM_SET:
            self.values[name] = struct.unpack("<f", struct.pack("<f", fields[0]))[0]
        return self.values[name], 3, 0, name.encode().ljust(16, b"\0"), 9


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 1500), st.booleans()), max_size=40))
@settings(max_examples=60, deadline=None)
def test_done_means_read_back_right_despite_loss_delay_and_repeats(
    fates: list[tuple[bool, bool, int, bool]],
) -> None:
    """Each frame's fate: lost on the way there, lost on the way back, ms until the answer arrives, answered twice."""
    upload, holder = Upload(NUMBERS), Holder()
    under_way: list[tuple[int, tuple[object, ...]]] = []
    fate = iter(fates)
    for tick in range(60 * 50):
        now_ns = tick * 20 * MS
        for due_ns, answer in [entry for entry in under_way if entry[0] <= now_ns]:
            upload.take(answer)
            under_way.remove((due_ns, answer))
        due = upload.next(now_ns, target_system=1, rtt_ns=0)
        if due is not None:
            there, back, late_ms, twice = next(fate, (False, False, 40, False))
            if not there:
                answer = holder.answer(*due)
                under_way += [] if back else [(now_ns + late_ms * MS, answer)] * (2 if twice else 1)
        if upload.done:
            assert holder.values == {name: float32(value) for name, value in NUMBERS.items()}
            return
    pytest.fail("never done, though nothing was lost any more")


def test_numbers_are_compared_as_float32() -> None:
    assert float32(0.1) != 0.1
    upload, holder = Upload({"FORM_B": 0.1}), Holder()
    for now_ns in (0, 20 * MS):
        due = upload.next(now_ns, target_system=1, rtt_ns=0)
        assert due is not None
        upload.take(holder.answer(*due))
    assert upload.done
    assert upload.next(40 * MS, target_system=1, rtt_ns=0) is None


@pytest.mark.parametrize("reported", [-17.0088, float("nan")])
def test_vehicles_that_keep_another_value_are_refused_in_one_line(reported: float) -> None:
    upload = Upload({"FORM_A": -17.0089})
    for attempt in range(ATTEMPTS):
        assert not upload.refusal
        assert upload.next(attempt * 20 * MS, target_system=1, rtt_ns=0) is not None
        upload.take((reported, 1, 0, b"FORM_A".ljust(16, b"\0"), 9))
    assert upload.refusal.startswith("holds ")
    assert "\n" not in upload.missing
    assert not upload.done
    assert upload.next(10**12, target_system=1, rtt_ns=0) is None


def test_nothing_is_asked_twice_before_three_round_trips() -> None:
    upload = Upload({"FORM_A": 1.0})
    assert upload.next(0, target_system=1, rtt_ns=2000 * MS) is not None
    assert upload.next(5999 * MS, target_system=1, rtt_ns=2000 * MS) is None
    assert upload.next(6000 * MS, target_system=1, rtt_ns=2000 * MS) is not None


def test_answers_nobody_asked_for_change_nothing() -> None:
    upload = Upload({"FORM_A": 1.0})
    upload.take((1.0, 1, 0, b"FORM_A".ljust(16, b"\0"), 9))
    upload.take((1.0, 1, 0, b"\xff\xfe".ljust(16, b"\0"), 9))
    assert upload.next(0, target_system=7, rtt_ns=0) == (
        mavlink.PARAM_SET,
        mavlink.param_set("FORM_A", 1.0, target_system=7),
    )
