"""With plain vehicles, kernels do nearly all steps of a station in real time, and record what Python steps would."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from gcs.drive import fly
from gcs.drive.flown import fly_real_time, margins_of
from gcs.link import mavlink
from gcs.plan.planner import flight_plan
from gcs.runs.files import read_summary
from gcs.runs.record import SUMMARY_FILE, TLOG_FILE
from gcs.station.station import Station
from gcs.watch.rebuild_report import find_log, rebuild_report
from gcs.watch.tlog import read_tlog
from scenarios.files import load
from tests.support.known import known
from tests.support.paths import SCENARIOS

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]
SECONDS = 4.0


class Counting(Station):
    """A station that counts its steps in Python in flight."""

    steps, plainly = 0, False

    @property
    def has_fast_path(self) -> bool:
        return super().has_fast_path and not self.plainly

    def step(self, datagrams: Any, now_ns: int, taken: int = 0) -> Any:
        type(self).steps += self.phase.name == "FLYING"
        return super().step(datagrams, now_ns, taken)


@pytest.mark.parametrize(
    ("plainly", "one_port"), [(False, False), (True, False), (False, True)], ids=["kernels", "Python", "one port"]
)
def test_the_log_of_a_flight_tells_what_its_ticks_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plainly: bool, one_port: bool
) -> None:
    monkeypatch.setattr(fly, "Station", Counting)
    monkeypatch.setattr(Counting, "plainly", plainly)
    monkeypatch.setattr(Counting, "steps", 0)
    scenario = load(SCENARIOS / "triangle5.toml")
    links = scenario.links.model_copy(update={"one_port": one_port})
    _, plan = flight_plan(scenario.model_copy(update={"duration_s": SECONDS, "links": links}))
    fly_real_time(plan, margins_of(plan), tmp_path)
    log = read_tlog(tmp_path / TLOG_FILE)
    flown, rebuilt = read_summary(tmp_path / SUMMARY_FILE), rebuild_report(log, find_log(tmp_path)).flight
    assert rebuilt is not None
    assert (rebuilt.verdict, rebuilt.reason) == (flown.verdict, flown.reason)
    assert flown.control is not None
    assert flown.control.ticks == pytest.approx(50 * SECONDS, abs=2)
    assert (Counting.steps < 0.1 * flown.control.ticks) != plainly
    for was, other in ((flown, rebuilt), *zip(flown.vehicles, rebuilt.vehicles, strict=True)):
        for quantile in ("p50", "p95"):  # the log has no wait in the socket, and its times are whole µs
            assert known(getattr(other.loop_delay_s, quantile)) == pytest.approx(
                known(getattr(was.loop_delay_s, quantile)), abs=5e-6
            )
    assert log.counters == {}
    sent = Counter(frame.msg_id for _, frame in log.frames if frame.system_id == mavlink.STATION_SYSTEM_ID)
    assert sent[mavlink.SET_POSITION_TARGET_LOCAL_NED] == pytest.approx(5 * flown.control.ticks, abs=10)
    assert sent[mavlink.TIMESYNC] > 5 * 10 * SECONDS  # ten a second to each vehicle, and some before the flight
    assert SECONDS <= sent[mavlink.HEARTBEAT] / (1 if one_port else 5) <= 3 * SECONDS
