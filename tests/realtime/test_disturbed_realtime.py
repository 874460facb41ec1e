"""A disturbed formation over UDP on the real clock: its errors spread as computed."""

import json
from pathlib import Path

import pytest

from scenarios.files import dump, load
from scenarios.keys.disturbance import Disturbance, Gusts, Navigation
from scenarios.schema import Clocks
from tests.support.paths import SCENARIOS
from tests.support.processes import gcs

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]


def test_over_udp_errors_spread_as_predicted(tmp_path: Path) -> None:
    chain = load(SCENARIOS / "chain3.toml").with_link_delay(up_s=0.05, down_s=0.05)
    noisy = {
        "disturbance": Disturbance(gusts=Gusts(deviation_m_s2=0.4, correlation_time_s=0.2)),
        "navigation": Navigation(position_noise_m=0.3, velocity_noise_m_s=0.1),
        "clocks": Clocks(offset_max_s=0.0, drift_max_ppm=0.0),
        "safety": chain.safety.model_copy(update={"settled_fraction": 0.5}),
        "duration_s": 25.0,
    }
    file = tmp_path / "noisy.toml"
    file.write_text(dump(chain.model_copy(update=noisy)), encoding="utf-8")
    flown = gcs("fly", file, "--listen", "127.0.0.1:0", "--json", "--out", tmp_path / "run")
    assert flown.returncode == 0, flown.stderr
    spread = json.loads(flown.stdout)["spread"]
    ratios = [own["reported_rms_m"] / own["predicted_rms_m"] for own in spread["vehicles"]]
    # 20 s of mostly white noise: 5 % for a standard error of either, as in tests/flights/loops/test_disturbed_flight.py
    assert ratios == pytest.approx([1.0, 1.0], abs=0.15)
