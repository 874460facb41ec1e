"""Code that a scenario names: read and written with it, never run by reading it."""

from pathlib import Path

import pytest

from scenarios.errors import ScenarioError
from scenarios.files import checked, dump, fingerprint, load
from scenarios.own_code import LARGEST_BYTES, function_of, write_code
from scenarios.schema import Response
from tests.support.fleets.own_code import LAW, coded

MARKS = "from pathlib import Path\nPath(__file__).with_name('ran').touch()\n" + LAW


def written(folder: Path, text: str = LAW, **keys: str) -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "own.toml"
    scenario = coded(text, **(keys or {"law": "soft"}))
    file.write_text(dump(scenario))
    write_code(scenario, folder)
    return file


def test_a_scenario_with_code_is_read_back_equal(tmp_path: Path) -> None:
    for keys in ({"law": "linear", "linear": "matrices"}, {"law": "soft", "dynamics": "lagged"}):
        assert load(written(tmp_path, **keys)) == coded(LAW, **keys)


def test_reading_a_scenario_never_runs_its_code(tmp_path: Path) -> None:
    load(written(tmp_path, "raise RuntimeError\n" + MARKS, law="soft", linear="matrices", dynamics="step"))
    assert not list(tmp_path.glob("ran"))


def test_a_copy_in_another_folder_is_the_same_experiment(tmp_path: Path) -> None:
    """The vehicles, in a process of their own, read it from the folder of the run."""
    first = written(tmp_path / "deep")
    above = tmp_path / "above.toml"
    above.write_text(first.read_text().replace('"own.py:soft"', '"deep/own.py:soft"'))
    scenario = load(above)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "scenario.toml").write_text(dump(scenario))
    write_code(scenario, tmp_path / "run")
    again = load(tmp_path / "run" / "scenario.toml")
    assert again.control.controller == "own.py:soft"
    assert fingerprint(again) == fingerprint(scenario) != fingerprint(coded(LAW + "\n", law="soft"))


@pytest.mark.parametrize(
    ("was", "becomes", "wanted"),
    [
        ('"own.py:soft"', '"none.py:soft"', "read 'none.py': No such file or directory, wanted a readable Python file"),
        ('"own.py:soft"', '"own.py"', ": control.controller: read 'own.py', wanted FILE.py:NAME"),
        ('"own.py:soft"', '"own.py:soft"\nalpha = 0.5', "wanted no such key with method python"),
        (
            '"own.py:soft"',
            '"own.py:soft"\ngains.K1 = -1.0\ngains.K2 = 0.0\ngains.K3 = 1.0',
            "no such key with method python",
        ),
        ('prediction = "off"', "prediction = 0.2", "wanted off, with method python"),
        ('method = "python"', 'method = "inclusion"', "wanted no such key, unless method is python"),
        ('controller = "own.py:soft"', "", ": control.controller: read nothing, wanted FILE.py:NAME"),
        ('loop = "ground"', 'loop = "onboard"', "wanted ground, with method python"),
        (
            'dynamics = "double_integrator"',
            'dynamics = "bird"',
            "double_integrator, autopilot, jsbsim, jsbsim:MODEL, or FILE.py:NAME",
        ),
    ],
)
def test_contradictions_are_refused(was: str, becomes: str, wanted: str, tmp_path: Path) -> None:
    file = written(tmp_path)
    text = file.read_text()
    assert was in text
    file.write_text(text.replace(was, becomes, 1))
    with pytest.raises(ScenarioError) as refused:
        load(file)
    assert wanted in str(refused.value)
    assert str(refused.value).startswith(f"{file}: line ")


def test_text_of_code_is_no_key(tmp_path: Path) -> None:
    file = written(tmp_path)
    file.write_text(file.read_text() + '\n[[code]]\nname = "own.py"\ntext = "x = 1"\n')
    with pytest.raises(ScenarioError, match="no such key: files of code are named by other keys"):
        load(file)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    file = written(tmp_path)
    (tmp_path / "own.py").write_text("#" * (LARGEST_BYTES + 1))
    with pytest.raises(ScenarioError, match="1000001 bytes"):
        load(file)


def test_response_of_own_dynamics_has_no_velocity_gain(tmp_path: Path) -> None:
    scenario = coded(dynamics="lagged", response=Response(lag_s=0.1))
    assert checked(scenario, tmp_path) is scenario
    with pytest.raises(ScenarioError, match="set-points carry accelerations only"):
        checked(coded(dynamics="lagged", response=Response(lag_s=0.1, velocity_gain_1_s=1.0)), tmp_path)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("raise OSError('gone')", "OSError: gone"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("def law(", "SyntaxError"),
        ("soft = 3", "the name of a function in this file"),
        ("", "the name of a function in this file"),
    ],
)
def test_a_file_that_does_not_define_the_function_is_refused(text: str, wanted: str) -> None:
    with pytest.raises(ScenarioError, match=wanted):
        function_of(coded(text, law="soft"), "control.controller")
