"""The monitor over UDP on the real clock: the verdicts and the modes of virtual time, flight by flight."""

import json
from pathlib import Path

import pytest

from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.plan.planner import flight_plan
from gcs.runs.record import event_fields
from gcs.station.station import Station
from scenarios.files import dump, load
from scenarios.keys.link import DelayPoint, Jitter, Link, Links
from scenarios.schema import Monitor, Scenario
from tests.support.paths import SCENARIOS
from tests.support.processes import gcs

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]

TRIANGLE = load(SCENARIOS / "triangle5.toml")
CALM = Link(delay_s=0.02, jitter=Jitter(distribution="exponential", scale_s=0.003))


def ramp(*points: tuple[float, float]) -> Links:
    link = Link(delay_points=tuple(DelayPoint(at_s=at_s, delay_s=delay_s) for at_s, delay_s in points))
    return Links(up=link, down=link)


FLOWN: dict[str, Scenario] = {
    # to three times the margin of 300 ms, and back
    "acting": TRIANGLE.model_copy(
        update={"duration_s": 32.0, "links": ramp((4.0, 0.02), (16.0, 0.44), (19.0, 0.44), (23.0, 0.02))}
    ),
    "nominal": TRIANGLE.model_copy(update={"duration_s": 12.0, "links": Links(up=CALM, down=CALM)}),
    "watching": TRIANGLE.model_copy(
        update={"duration_s": 32.0, "links": ramp((4.0, 0.02), (16.0, 0.44)), "monitor": Monitor(act=False)}
    ),
}
ENDED = {"acting": "completed", "nominal": "completed", "watching": "broken"}


def modes(events: list[dict[str, object]], system_id: int) -> set[str]:
    """The modes that a vehicle took in flight."""
    texts = [str(e["text"]) for e in events if e["kind"] == "mode" and e["system_id"] == system_id]
    return {text.split("-> ")[1].split()[0] for text in texts}


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("name", FLOWN)
def test_over_udp_verdict_and_modes_are_those_of_virtual_time(name: str, tmp_path: Path) -> None:
    scenario, file = FLOWN[name], tmp_path / f"{name}.toml"
    file.write_text(dump(scenario), encoding="utf-8")
    done = gcs("fly", file, "--listen", "127.0.0.1:0", "--json", "--out", tmp_path / name)
    station = Station(flight_plan(scenario)[1], start_ns=START_NS)
    for _ in fly_lockstep(station.plan, station=station):
        pass
    assert done.stderr == ""
    assert str(json.loads(done.stdout)["reason"]).split(":")[0] == station.end_reason.split(":")[0] == ENDED[name]
    lines = (tmp_path / name / "events.jsonl").read_text(encoding="utf-8").splitlines()
    real, virtual = [json.loads(line) for line in lines], [event_fields(event) for event in station.events]
    for vehicle in scenario.vehicles:
        flown = modes(real, vehicle.system_id)
        assert flown >= modes(virtual, vehicle.system_id), vehicle.system_id
        # a busy machine delays more than the links do, but not by the margin
        assert name != "nominal" or "CRITICAL" not in flown
