"""What `gcs grade` says of a run."""

from pathlib import Path

import pytest

from gcs.cli.runs import print_grade
from gcs.runs.grade import grade
from tests.support.commands import exit_code

pytestmark = pytest.mark.xdist_group("processes")  # flights start an observer process

LONE = """
name = "lone"
seed = 1
duration_s = 10.0
nominal_velocity = [{ from_s = 0.0, velocity_ne_m_s = [25.0, 0.0] }]
vehicles = [{ system_id = 1, position_ne_m = [0, 0], velocity_ne_m_s = [25, 0] }]
"""
JITTER = ', jitter = { distribution = "uniform", scale_s = 0.02 }, reordering = true'


@pytest.mark.parametrize(("more", "half_s"), [("", 0.0), (JITTER, 0.01)])
def test_the_grade_gives_jittery_links_as_a_reason(
    more: str, half_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    link = f"{{ delay_s = 0.05{more} }}"
    Path("lone.toml").write_text(f"{LONE}links = {{ up = {link}, down = {link} }}\n")
    assert exit_code(monkeypatch, "fly", "lone.toml", "--virtual", "--out", "run", "--json") == 0
    capsys.readouterr()
    found = grade(Path("run"))
    print_grade(found)
    assert ("jitter" in capsys.readouterr().out) == bool(more)
    # half of the draws of a uniform distribution are within half its scale; some 600 datagrams
    assert found.down_jitter.error_p50_s == pytest.approx(half_s, rel=0.1, abs=1e-12)
