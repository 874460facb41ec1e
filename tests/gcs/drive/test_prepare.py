"""A prepared flight compiles nothing: a compilation takes seconds in which vehicles hear nothing."""

import subprocess
import sys

import pytest

FLIGHT = """
import gc, sys
from gcs.drive.lockstep import fly_lockstep, prepare, vehicles_of
from gcs.plan.planner import flight_plan
from scenarios.files import load
from scenarios.keys.link import Link, Links
from scenarios.schema import Response
from tests.gcs.drive.test_fast_path import StepByStep
from tests.support.paths import SCENARIOS

def compiled():
    kernels = [each for each in gc.get_objects() if type(each).__name__ == "_Kernel" and each._compiled is not None]
    # in real time, the vehicles' kernels run in a process of their own
    ours = [each for each in kernels if each._name.startswith(("gcs.", "scenarios.sockets."))]
    return {each._name: len(each._compiled.signatures) for each in ours}

name, prediction = sys.argv[1:]
scenario, lossy = load(SCENARIOS / f"{name}.toml"), Link(delay_s=0.05, loss_probability=0.1, duplicate_probability=0.1)
control = scenario.control.model_copy(update={"prediction": prediction})
changes = {"control": control, "links": Links(up=lossy, down=lossy), "duration_s": 4.0, "response": None}
if scenario.dynamics == "autopilot":
    changes["response"] = Response(lag_s=0.3, velocity_gain_1_s=1.0)
_, plan = flight_plan(scenario.model_copy(update=changes))
prepare(plan)
before = compiled()
assert len(before) > 10
assert "gcs.link.sequence.restart_at" in before  # needed after a long silence only
assert sum(1 for _ in fly_lockstep(plan, vehicles=StepByStep(vehicles_of(plan.scenario)))) > 200  # as in real time
assert compiled() == before, {name: count for name, count in compiled().items() if before.get(name) != count}
"""


@pytest.mark.parametrize(("name", "prediction"), [("triangle5", "off"), ("patrol", "measured"), ("copters5", "off")])
def test_nothing_is_compiled_in_a_prepared_flight(name: str, prediction: str) -> None:
    subprocess.run([sys.executable, "-c", FLIGHT, name, prediction], check=True)


IN_REAL_TIME = """
import tempfile
from pathlib import Path
import gcs.drive.fly as real_time
from gcs.drive.flown import margins_of
from gcs.drive.udp import StationSocket

def prepared(plan):
    prepare(plan)
    before.update(compiled())

before, real_time.prepare = {}, prepared
_, plan = flight_plan(load(SCENARIOS / "triangle5.toml").model_copy(update={"duration_s": 1.0}))
with StationSocket("127.0.0.1", 0) as link, tempfile.TemporaryDirectory() as folder:
    real_time.fly(plan, margins_of(plan), link, Path(folder), show_table=False)
assert compiled() == before, {name: count for name, count in compiled().items() if before.get(name) != count}
"""


@pytest.mark.realtime
@pytest.mark.xdist_group("realtime")
def test_nothing_is_compiled_in_a_flight_in_real_time() -> None:
    beginning = FLIGHT[: FLIGHT.index("name, prediction")]
    subprocess.run([sys.executable, "-c", beginning + IN_REAL_TIME], check=True)


AT_ONE_PORT = """
import socket
from sim_vehicles.drive.udp import Ports

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
    station.bind(("127.0.0.1", 0))
    ports = Ports((1, 2), station.getsockname(), one_port=True)
    before = compiled()
    assert "scenarios.sockets.write_all" in before
    ports.send([(1, b"one", 0), (2, b"two", 0)])
    ports.receive()
assert compiled() == before, {name: count for name, count in compiled().items() if before.get(name) != count}
"""


@pytest.mark.realtime
def test_vehicles_at_one_port_compile_nothing_when_they_first_send() -> None:
    beginning = FLIGHT[: FLIGHT.index("name, prediction")]
    subprocess.run([sys.executable, "-c", beginning + AT_ONE_PORT], check=True)
