"""`gcs identify`: known dynamics are found again, and the margin with what is found holds for an aircraft."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from gains.performance.response import Response
from gcs.autopilot.identify import Identified
from gcs.drive.flown import fly_plan
from gcs.errors import InputError
from gcs.plan.planner import flight_plan
from gcs.studies.identification import as_toml, responses_of
from scenarios.files import load, parse
from tests.support.paths import SCENARIOS

TEXANS = """
name = "texans"
seed = 1
duration_s = 40.0
dynamics = "jsbsim"
altitude_m = 400.0
nominal_velocity = [{ from_s = 0.0, velocity_ne_m_s = [91.44, 0.0] }]
vehicles = [
    { system_id = 1, position_ne_m = [0, 0], velocity_ne_m_s = [91.44, 0] },
    { system_id = 2, follows = 1, offset_ne_m = [-99, 99], position_ne_m = [-100, 100], velocity_ne_m_s = [91.44, 0] },
]
control = { gains = { K1 = -1.0, K2 = 0.0, K3 = 0.3 } }
"""
LAGGED = """
import numpy as np

def step(state, command, dt_s, memory):
    was = memory.get("acceleration", np.zeros(2))
    left = np.exp(-dt_s / 0.3)
    gone = 0.3 * (1.0 - left)
    memory["acceleration"] = command + (was - command) * left
    moved = dt_s * state[2:] + dt_s**2 / 2 * command + 0.3 * (dt_s - gone) * (was - command)
    return np.concatenate([state[:2] + moved, state[2:] + dt_s * command + gone * (was - command)])
"""


def test_a_known_lag_is_found_again(tmp_path: Path) -> None:
    (tmp_path / "lagged.py").write_text(LAGGED)
    file = tmp_path / "lagged.toml"
    file.write_text(TEXANS.replace('"jsbsim"', '"lagged.py:step"'))
    for found in responses_of(load(file)).values():
        assert found.response.model == "lag"
        assert found.response.lag_s == pytest.approx(0.3, rel=0.005)
        assert found.misfit < 0.002


def test_a_known_lag_is_found_at_a_slow_control_rate(tmp_path: Path) -> None:
    """At 1 Hz the flight would have 32 samples, and set-points rarer than the timeout of the failsafe."""
    (tmp_path / "lagged.py").write_text(LAGGED)
    file = tmp_path / "lagged.toml"
    file.write_text(
        TEXANS.replace('"jsbsim"', '"lagged.py:step"') + "rates = { control_hz = 1.0, telemetry_hz = 1.0 }\n"
        "safety = { setpoint_timeout_s = 0.08 }\n"
    )
    found = responses_of(load(file))
    for own in found.values():
        assert own.response.lag_s == pytest.approx(0.3, rel=0.005)
    # the same along and across, to rounding
    assert "# both lag alike at 1 rad/s" in as_toml(found)


def test_axes_that_differ_by_more_than_their_misfits_are_ranked() -> None:
    misfits = {"lag": 0.005}
    quick, slow = (Identified(Response(lag_s, 0.0, 0.0, None), 0.005, 100, misfits) for lag_s in (0.3, 0.33))
    assert "# across the course it lags more at 1 rad/s" in as_toml({"along": quick, "across": slow})
    assert "# along the course it lags more at 1 rad/s" in as_toml({"along": slow, "across": quick})


def test_no_velocity_gain_is_found_where_none_is_accepted(tmp_path: Path) -> None:
    # a vehicle that responds at once; with a velocity gain, other commands refuse the response
    (tmp_path / "at_once.py").write_text(
        "import numpy as np\n\ndef step(state, command, dt_s, memory):\n"
        "    moved = dt_s * state[2:] + dt_s**2 / 2 * command\n"
        "    return np.concatenate([state[:2] + moved, state[2:] + dt_s * command])\n"
    )
    text = TEXANS.replace('"jsbsim"', '"at_once.py:step"')
    file = tmp_path / "at_once.toml"
    file.write_text(text)
    found = responses_of(load(file))
    assert all(one.response.velocity_gain_1_s == 0.0 and one.misfit < 0.01 for one in found.values())
    file.write_text(text + as_toml(found))
    assert load(file).response is not None
    assert as_toml(found).count("lag at most 0.010 s, the shortest that is fitted") == 2


def test_aircraft_flies_to_the_margin_computed_with_its_identified_response() -> None:
    scenario = parse(TEXANS, SCENARIOS / "texans.toml")
    found = responses_of(scenario)
    assert all(one.response.model == "second order" and one.misfit < 0.03 for one in found.values())
    scenario = parse(TEXANS + as_toml(found), SCENARIOS / "texans.toml")
    assert scenario.response is not None
    assert tomllib.loads(as_toml(found))["response"]["lag_s"] == scenario.response.lag_s
    margin_s = flight_plan(scenario)[1].delay_margin_s
    grown: list[float] = []
    # the onset is within 3 % of the margin; a tenth away from it errors change several times over in 40 s
    for share in (0.9, 1.1):
        late = scenario.with_link_delay(up_s=0.5 * share * margin_s, down_s=0.5 * share * margin_s)
        ticks = fly_plan(flight_plan(late.with_calm_monitor())[1]).ticks
        own = ticks[(ticks["system_id"] == 2) & ticks["commanded"]]
        error_m = np.hypot(own["spacing_error_north_m"], own["spacing_error_east_m"])
        at_s = own["time_s"]
        grown.append(float(error_m[at_s > 30.0].max() / error_m[(at_s > 5.0) & (at_s < 15.0)].max()))
    assert grown[0] < 0.8
    assert grown[1] > 1.25


def test_vehicles_that_need_no_identification_are_refused() -> None:
    with pytest.raises(InputError, match="dynamics: read 'double_integrator', wanted jsbsim, or dynamics in a Python"):
        responses_of(load(SCENARIOS / "triangle5.toml"))
