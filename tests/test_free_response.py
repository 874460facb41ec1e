"""The free response of one loop through random links, against its linear model through the same delays."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from stress_pair import SCENARIO, pair_plan

from gcs.effective_delay import commands_of, effective_delay_s
from gcs.free_response import FreeResponse, fly_calm, response_paired
from gcs.growth import CHANNELS, FloatArray
from gcs.measure import fly_trial
from gcs.onset import Loop
from gcs.plan import FlightPlan
from gcs.stress_axes import at_coordinates
from gcs.study import Study
from gcs.trial import plan_loops

PERIOD_S = 0.02


def plan_with(**coordinates: float) -> FlightPlan:
    return replace(pair_plan(), scenario=at_coordinates(SCENARIO, coordinates))


def modelled(loop: Loop, response: FreeResponse, before: FloatArray) -> FloatArray:
    """The loop's errors at the samples of the response's rows, integrated from command to command.

    x' = A x + B u exactly, u = K x(sampled) from the instant at which each command acted, u = 0 before the first.
    """
    truth = response.flight.truth
    assert truth is not None
    commands = commands_of(response.errors, truth, loop.system_ids[0])
    sampled_ns = {
        int(row["key"]): int(row["time_ns"])
        for row in truth
        if row["kind"] == 1 and row["system_id"] == loop.system_ids[0]
    }
    wanted_ns = [sampled_ns[boot_ms] for boot_ms in response.errors["sample_boot_ms"].tolist()]
    acts = dict(commands.tolist())
    x, u, at = before, np.zeros(loop.B.shape[1]), dict[int, FloatArray]()
    generator = np.zeros((len(x) + len(u),) * 2)
    generator[: len(x)] = np.hstack([loop.A, loop.B])
    last_ns: int | None = None
    for now_ns in sorted({*acts, *acts.values(), *wanted_ns}):
        if last_ns is not None:
            step = expm(generator * (now_ns - last_ns) * 1e-9).astype(np.float64)
            x = (step @ np.concatenate([x, u]))[: len(x)]
        at[now_ns] = x
        if now_ns in acts:
            u = loop.K @ at[acts[now_ns]]
        last_ns = now_ns
    return np.array([at[time_ns] for time_ns in wanted_ns])


@pytest.mark.parametrize(
    "coordinates",
    [{"delay": 0.15, "jitter": 0.03}, {"delay": 0.15, "loss": 0.4}, {"delay": 0.25, "jitter": 0.01, "loss": 0.2}],
)
def test_a_loop_on_random_links_is_its_linear_model_through_the_delays_drawn(coordinates: dict[str, float]) -> None:
    """Two independent ways, to the last digits of telemetry, though the links push the vehicles by metres."""
    plan = plan_with(**coordinates)
    [_, follower] = plan_loops(plan)
    calm = fly_calm(plan, None)
    response = response_paired(plan, calm, (2,), amplitude=1.0, folder=None)
    flown = np.stack([response.errors[name] for name in CHANNELS], axis=1)
    early = response.errors["time_s"] < 5.0
    model = modelled(follower, response, before=np.array([-1.0, 1.0, 0.0, 0.0]))
    assert np.abs(flown).max() > 1.0
    assert flown[early] == pytest.approx(model[early], abs=2e-3)
    pushed = calm.ticks[(calm.ticks["system_id"] == 2) & calm.ticks["commanded"]]
    assert np.nanmax(np.abs(pushed["spacing_error_north_m"])) > 0.1


def test_effective_delay_of_regular_commands_is_their_loop_delay() -> None:
    acted_ns = 1_000_000_000 + 20_000_000 * np.arange(50, dtype=np.int64)
    commands = np.stack([acted_ns, acted_ns - 130_000_000], axis=1)
    assert effective_delay_s(commands, period_s=PERIOD_S) == pytest.approx(0.130, abs=1e-12)


def test_every_second_command_lost_adds_half_a_period_to_the_effective_delay() -> None:
    acted_ns = 1_000_000_000 + 40_000_000 * np.arange(50, dtype=np.int64)
    commands = np.stack([acted_ns, acted_ns - 130_000_000], axis=1)
    assert effective_delay_s(commands, period_s=PERIOD_S) == pytest.approx(0.140, abs=1e-12)


def test_no_commands_have_no_delay() -> None:
    assert effective_delay_s(np.empty((0, 2), dtype=np.int64), period_s=PERIOD_S) == 0.0


def test_loss_is_predicted_by_the_effective_delay_and_not_by_the_median() -> None:
    """A third of the datagrams lost each way: the median of the loop delays knows nothing of commands that never came.

    The effective delay is right to first order in the variation, here to 0.05 1/s; the median is off by 0.2.
    """
    study = Study(pair_plan())
    outcome = fly_trial(study.trial("probe", {"delay": 0.15, "loss": 0.33}, seed=7))
    without = fly_trial(study.trial("probe", {"delay": 0.15}, seed=7))
    assert outcome.growth_1_s is not None
    assert outcome.predicted_growth_1_s is not None
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=0.05)
    assert without.growth_1_s is not None
    assert outcome.growth_1_s - without.growth_1_s > 0.2
