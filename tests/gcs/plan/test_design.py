"""The design of a scenario as a record, and as design.json."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from gcs.plan.design import Design, GainSet
from gcs.plan.planner import flight_plan
from gcs.runs.files import read_design, write_design
from gcs.runs.record import DESIGN_FILE
from scenarios.files import load, with_loop
from scenarios.schema import Response, Scenario
from tests.support.paths import ROOT

CHAIN = load(ROOT / "scenarios/chain3.toml")
DESIGNED = {
    "inclusion": CHAIN,
    "on board": with_loop(CHAIN, "onboard", ROOT / "scenarios/chain3.toml"),
    "pattern": load(ROOT / "scenarios/chain3_bidirectional.toml"),
    "response": load(ROOT / "scenarios/copters5.toml").model_copy(update={"response": Response(lag_s=0.15)}),
}


@pytest.mark.parametrize("scenario", DESIGNED.values(), ids=DESIGNED.keys())
def test_a_design_read_back_from_its_run_is_the_same(scenario: Scenario, tmp_path: Path) -> None:
    design, plan = flight_plan(scenario)
    write_design(tmp_path, design)
    assert read_design(tmp_path / DESIGN_FILE) == design
    assert design.margins_s == pytest.approx(plan.margins_s)
    assert (design.delay_margin_s or np.inf) == design.margins_s[0]


def test_a_design_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Design(delay_margin_s=0.3).alpha = 1.0  # pyrefly: ignore[read-only]


def test_infinite_margins_are_none_and_missing_parts_not_written() -> None:
    design = Design(delay_margin_s=np.inf)
    assert design.to_dict() == {"delay_margin_s": None}
    assert design.margins_s == (np.inf,)


def test_a_design_has_the_margins_of_its_first_gain_set() -> None:
    sets = (GainSet(delay_margin_s=0.2, delay_margin_continuous_s=0.21), GainSet(delay_margin_s=0.4))
    design = Design(delay_margin_s=0.3).with_schedule(sets, loop="onboard")
    assert (design.delay_margin_s, design.delay_margin_continuous_s, design.loop) == (0.2, 0.21, "onboard")
    assert design.margins_s == (0.2, 0.4)
