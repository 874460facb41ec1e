"""Flights in virtual time from Python."""

from pathlib import Path

import numpy as np
import pytest

import gcs
from gcs.errors import InputError
from gcs.runs.files import read_ticks
from scenarios.errors import ScenarioError
from scenarios.files import dump, load
from scenarios.schema import Control, FixedGains
from tests.support.commands import exit_code
from tests.support.paths import SCENARIOS


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("control", [Control(), Control(for_link="measured")])
def test_python_and_the_command_fly_the_same_bits(
    control: Control, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 3.0, "control": control})
    flight = gcs.fly_virtual(scenario)
    file = tmp_path / "chain3.toml"
    file.write_text(dump(scenario))
    exit_code(monkeypatch, "fly", file, "--virtual", "--out", tmp_path / "run", "--json")
    assert flight.ticks.tobytes() == read_ticks(tmp_path / "run").tobytes()
    assert flight.table().num_rows == flight.ticks.size
    assert (flight.design.for_link is None) == (control.for_link == "off")


def test_the_tutorial_names_every_array() -> None:
    page = (SCENARIOS.parent / "docs/tutorial/from-python.md").read_text()
    arrays = [name for name, value in vars(gcs.VirtualFlight).items() if isinstance(value, property)]
    assert [name for name in arrays if f"`{name}`" not in page] == []


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_table_becomes_a_data_frame_with_types_of_the_record(library: str) -> None:
    frames = pytest.importorskip(library)
    flight = gcs.fly_virtual(load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 3.0}))
    table = flight.table()
    frame = table.to_pandas() if library == "pandas" else frames.from_arrow(table)
    assert isinstance(frame, frames.DataFrame)
    assert list(frame.columns) == list(flight.ticks.dtype.names or ())
    for name in frame.columns:
        values = frame[name].to_numpy()
        assert values.dtype == flight.ticks.dtype[name]
        np.testing.assert_array_equal(values, flight.ticks[name].ravel())


def test_arrays_have_ticks_by_vehicles_and_agree_with_the_summary() -> None:
    flight = gcs.fly_virtual("triangle5")
    shape = flight.ticks.shape
    assert flight.system_ids == (1, 2, 4, 3, 5)
    assert flight.position_ne_m.shape == flight.velocity_ne_m_s.shape == flight.command_ne_m_s2.shape == (*shape, 2)
    error_m = np.hypot(flight.spacing_error_ne_m[..., 0], flight.spacing_error_ne_m[..., 1])
    flying = flight.time_s >= 0.0
    for column, system_id in enumerate(flight.system_ids):
        [summed_up] = [vehicle for vehicle in flight.summary.vehicles if vehicle.system_id == system_id]
        if summed_up.spacing_error_max_m is None:
            assert np.isnan(error_m[:, column]).all()
        else:
            assert np.nanmax(error_m[flying, column]) == pytest.approx(summed_up.spacing_error_max_m, abs=1e-6)
    assert np.nanmin(flight.headroom[flying]) == pytest.approx(flight.summary.headroom_min, abs=1e-6)
    assert (flight.loop_delay_s[flying] < 0.07).all()


def test_identified_responses_are_in_the_design() -> None:
    flight = gcs.fly_virtual("copters5")
    assert flight.design.response is not None
    assert [vehicle.lag_s for vehicle in flight.design.response.vehicles] == pytest.approx(5 * [0.15], abs=1e-6)


def test_python_refuses_what_the_command_refuses() -> None:
    with pytest.raises(ScenarioError, match="read no such file, wanted a scenario file"):
        gcs.fly_virtual("nonsense")
    scenario = load(SCENARIOS / "chain3.toml")
    control = {"gains": FixedGains(K1=3.0, K2=0.0, K3=1.0), "delay_margin_s": None}
    unstable = scenario.model_copy(update={"control": scenario.control.model_copy(update=control)})
    with pytest.raises(InputError, match="unstable without any delay"):
        gcs.fly_virtual(unstable)
    assert gcs.fly_virtual(unstable, allow_unstable=True).summary.verdict == "unstable"
