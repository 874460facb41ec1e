"""What is said of a flight as a whole."""

import pytest

from gcs import fly_virtual
from gcs.plan.planner import flight_plan, with_trade_off
from gcs.views.report import flight_lines, print_design
from scenarios.files import load
from scenarios.keys.link import Link, Links, Outage, VehicleLinks
from scenarios.schema import Control, FixedGains, Rates
from scenarios.shipped import located


def test_a_settled_flight_says_how_long_vehicles_left_nominal() -> None:
    """The last vehicle is silent for 4 s, after which it is in failsafe for a tick or two."""
    calm = Link(delay_s=0.02)
    silent = calm.model_copy(update={"outages": (Outage(from_s=10.0, until_s=14.0),)})
    links = Links(up=calm, down=calm, vehicles=(VehicleLinks(system_id=3, up=silent, down=silent),))
    summary = fly_virtual(load(located("chain3")).model_copy(update={"links": links})).summary
    assert summary.verdict == "stable"
    in_failsafe, lost, critical = flight_lines(summary)["modes"].split(", ")
    assert in_failsafe == "vehicle 3 FAILSAFE for 0.04 s"
    assert lost == "vehicle 3 LOST for 2.52 s"
    assert critical.startswith("vehicle 3 CRITICAL for 0.")
    assert {own.mode_final for own in summary.vehicles} == {"NOMINAL"}


def test_margins_of_single_vehicles_are_not_mistaken_for_slower_gains() -> None:
    quick, slow = Link(delay_s=0.02), Link(delay_s=0.09)
    links = Links(up=quick, down=quick, vehicles=(VehicleLinks(system_id=3, up=slow, down=slow),))
    scenario = load(located("chain3_bidirectional")).model_copy(update={"links": links, "duration_s": 5.0})
    assert "; margin 390.0 to 503.7 ms by vehicle; " in flight_lines(fly_virtual(scenario).summary)["delay"]


def test_one_vehicle_alone_has_figures_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    """e' = K1 e + w stays stable for any w smaller than −K1 times e, and decays at −K1."""
    chain = load(located("chain3"))
    design = with_trade_off(flight_plan(chain.model_copy(update={"vehicles": chain.leader_first()[:1]}))[0])
    print_design(design)
    said = capsys.readouterr().out
    assert design.K1_1_s is not None
    own = -design.K1_1_s[0][0]
    assert f"alpha    {own:.4f} (robustness bound), decay {own:.2f} 1/s" in said
    assert "K2" not in said
    assert "trade-off" not in said


def test_a_flight_nominal_throughout_says_nothing_of_modes() -> None:
    calm = load(located("chain3")).model_copy(update={"duration_s": 5.0})
    assert "modes" not in flight_lines(fly_virtual(calm).summary)


def test_a_broken_flight_makes_no_claim_about_growth() -> None:
    """70 % of the set-points are lost, which the station cannot see: by what it measures, much headroom is left."""
    calm, lossy = Link(delay_s=0.02), Link(delay_s=0.02, loss_probability=0.7)
    chain = load(located("chain3"))
    safety = chain.safety.model_copy(update={"setpoint_timeout_s": 100.0, "heartbeat_timeout_s": 100.0})
    control = Control(gains=FixedGains(K1=-2.6, K2=0.5, K3=2.5))
    changes = {"rates": Rates(control_hz=5.0, telemetry_hz=5.0), "safety": safety, "control": control, "seed": 11}
    summary = fly_virtual(chain.model_copy(update={**changes, "links": Links(up=calm, down=lossy)})).summary
    lines = flight_lines(summary)
    assert (summary.verdict, (summary.headroom_end or 0.0) > 0.4) == ("unstable", True)
    assert "grow" not in lines["alpha"]
    assert " by the model of small errors at " in lines["alpha"]
    assert lines["delay"].endswith("; set-points that were lost do not show in it")


def test_unknown_verdict_says_what_is_unknown() -> None:
    """From 5 s on, nothing reaches the last vehicle, which keeps flying."""
    calm = Link(delay_s=0.02)
    dead = calm.model_copy(update={"outages": (Outage(from_s=5.0, until_s=100.0),)})
    chain = load(located("chain3"))
    safety = chain.safety.model_copy(update={"setpoint_timeout_s": 100.0, "heartbeat_timeout_s": 100.0})
    links = Links(up=calm, down=calm, vehicles=(VehicleLinks(system_id=3, up=calm, down=dead),))
    summary = fly_virtual(chain.model_copy(update={"safety": safety, "links": links})).summary
    said = flight_lines(summary)["verdict"]
    assert (summary.verdict, said.partition("; ")[0]) == (
        "unknown",
        "completed: duration reached, but a loop delay was unknown at the end",
    )
