"""The limits that vehicles report, and commands kept within them."""

from gcs.autopilot.kinds import ARDUCOPTER, PX4_COPTER
from gcs.autopilot.vehicle_limits import ReportedLimits
from gcs.link.kinds import UNRECOGNISED, Kind

SECOND = 1_000_000_000


def answered(kind: Kind, values: dict[bytes, float]) -> tuple[ReportedLimits, list[bytes]]:
    """The limits after ten seconds of requests, and the names requested; a vehicle answers those in `values`."""
    limits, asked = ReportedLimits(), list[bytes]()
    for k in range(500):
        due = limits.next(kind, k * SECOND // 50, target_system=1, rtt_ns=0)
        if due is not None:
            name = due[1][3]
            asked.append(name)
            if name in values:
                limits.take((values[name], 3, 0, name + b"\0", 9))
    return limits, asked


def test_an_arducopters_limits_bound_what_it_is_sent() -> None:
    limits, asked = answered(ARDUCOPTER, {b"WPNAV_ACCEL": 250.0, b"PSC_JERK_XY": 5.0, b"GUID_TIMEOUT": 3.0})
    assert (limits.acceleration_bound_m_s2, limits.jerk_bound_m_s3) == (2.25, 4.0)
    assert limits.in_words().endswith(", GUID_TIMEOUT 3 s")
    assert len(asked) == 3


def test_a_px4s_limits_bound_what_it_is_sent() -> None:
    limits, _ = answered(PX4_COPTER, {b"MPC_ACC_HOR": 3.0, b"MPC_JERK_AUTO": 4.0})
    assert abs(limits.acceleration_bound_m_s2 - 2.7) < 1e-9
    assert abs(limits.jerk_bound_m_s3 - 3.2) < 1e-9


def test_a_vehicle_without_valid_limits_is_asked_nine_times() -> None:
    limits, asked = answered(ARDUCOPTER, {b"WPNAV_ACCEL": float("nan"), b"PSC_JERK_XY": -1.0})
    assert len(asked) == 9
    assert (limits.acceleration_bound_m_s2, limits.jerk_bound_m_s3) == (2.0, 4.0)
    assert limits.in_words().endswith("it reports no limits")


def test_implausible_values_are_no_limits() -> None:
    values = {b"WPNAV_ACCEL": 3.5e-43, b"PSC_JERK_XY": 1e30}  # an integer's bytes, read as a float; a broken frame
    limits, _ = answered(ARDUCOPTER, values)
    assert (limits.acceleration_bound_m_s2, limits.jerk_bound_m_s3) == (2.0, 4.0)


def test_answers_to_nothing_asked_are_ignored() -> None:
    limits = ReportedLimits()
    limits.take((10.0, 3, 0, b"WPNAV_ACCEL\0", 9))
    assert limits.next(UNRECOGNISED, 0, target_system=1, rtt_ns=0) is None
    assert limits.in_words().endswith("it reports no limits")
