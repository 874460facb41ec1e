"""Random experiments for the soak: a valid scenario, and what goes wrong in flight."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from scenarios import files, schema
from scenarios.schema import Scenario
from tests.soak.soak_draws import Part, Rng, between, chance, one_of, spread, whole
from tests.soak.soak_scenarios import AUTOPILOT_START_S, fixed_gains, random_scenario, random_vehicles


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong in flight. Times are since the vehicles' start.

    silence           nothing passes to or from these vehicles
    killed            the same, for good
    station replaced  the station dies at `from_s`; another one starts at `until_s`
    garbage           hostile datagrams reach both ends of these vehicles' links, and the station from a stranger
    clock step        the boot clocks of these vehicles are set by `by_s` at `from_s`
    """

    kind: Literal["silence", "killed", "station replaced", "garbage", "clock step"]
    from_s: float
    until_s: float = math.inf
    system_ids: tuple[int, ...] = ()
    by_s: float = 0.0


@dataclass(frozen=True)
class Experiment:
    """One flight of the soak: everything that it depends on."""

    scenario: Scenario
    faults: tuple[Fault, ...] = ()
    signed: bool = False
    twice: bool = False
    """Flown a second time, which must give the same bytes."""
    margin_ratio: float | None = None
    """The loop delay is brought to this multiple of the plan's margin, and stability is judged."""
    allow_unstable: bool = False
    """Flown even if the loop is unstable without any delay."""

    def save(self, file: Path) -> None:
        """Write the scenario, and the rest beside it."""
        file.write_text(files.dump(self.scenario), encoding="utf-8")
        rest = asdict(self) | {"scenario": file.name}
        file.with_suffix(".json").write_text(json.dumps(rest, indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, file: Path) -> Self:
        """Read what `save` wrote."""
        rest = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))
        faults = tuple(Fault(**fault | {"system_ids": tuple(fault["system_ids"])}) for fault in rest.pop("faults"))
        return cls(**rest | {"scenario": files.load(file), "faults": faults})


def experiment(seed: int, number: int) -> Experiment:
    """Flight `number` of a soak's seed."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    if chance(rng, 0.2):
        return _margin_experiment(rng, f"soak-{seed}-{number}")
    scenario = valid(random_scenario(rng, f"soak-{seed}-{number}"))
    faults = _faults(rng, scenario) if chance(rng, 0.5) else ()
    signed, twice, allow_unstable = (chance(rng, probability) for probability in (0.15, 0.1, 0.5))
    return Experiment(scenario, faults, signed=signed, twice=twice, allow_unstable=allow_unstable)


def valid(drawn: Part) -> Scenario:
    """The drawn scenario, written as TOML and read back."""
    scenario = Scenario.model_validate_json(json.dumps(drawn))
    read = files.parse(files.dump(scenario), Path(f"{scenario.name}.toml"))
    assert read == scenario, "a scenario that was written is read back different"
    return read


def _faults(rng: Rng, scenario: Scenario) -> tuple[Fault, ...]:
    ids = sorted(vehicle.system_id for vehicle in scenario.vehicles)
    start_s = AUTOPILOT_START_S if scenario.dynamics == "autopilot" else 1.0
    faults: list[Fault] = []
    while not faults or (chance(rng, 0.4) and len(faults) < 4):
        kind = one_of(rng, "silence", "silence", "killed", "station replaced", "garbage", "garbage", "clock step")
        hit = tuple(system_id for system_id in ids if chance(rng, 0.5)) or (ids[-1],)
        from_s = between(rng, 0.0, start_s + scenario.duration_s)
        until_s = round(from_s + spread(rng, 0.05, 6.0), 4)
        by_s = one_of(rng, spread(rng, 0.001, 1000.0), -spread(rng, 0.001, 30.0))
        match kind:
            case "killed":
                faults.append(Fault(kind, from_s, system_ids=hit))
            case "clock step":
                faults.append(Fault(kind, from_s, system_ids=hit, by_s=by_s))
            case _:
                faults.append(Fault(kind, from_s, until_s, hit))
    return tuple(sorted(faults, key=lambda fault: fault.from_s))


def _margin_experiment(rng: Rng, name: str) -> Experiment:
    """An experiment for which the plan's margin must hold: given or designed gains, constant links, no limits."""
    onboard = chance(rng, 0.25)
    drawn = random_scenario(rng, name)
    count = min(len(drawn["vehicles"]), 6)
    control_hz = one_of(rng, 10.0, 25.0, 50.0, 50.0, 100.0)
    telemetry_hz = control_hz * one_of(rng, 1.0, 1.0, 0.2, 0.4, 0.5, 2.0, 2.5)
    slower_hz = min(control_hz, telemetry_hz)
    rates = whole(schema.Rates, control_hz=control_hz, telemetry_hz=telemetry_hz, timesync_hz=10.0, target_hz=10.0)
    speed_m_s, pitch_m = 100.0, 100.0
    vehicles = random_vehicles(rng, count, pitch_m, speed_m_s, autopilot=False)
    for vehicle in vehicles:
        vehicle.pop("hears", None)
    given = fixed_gains(rng, stable=chance(rng, 0.9), own_1_s=spread(rng, 0.5, 4.0))
    designed = chance(rng, 0.3)
    drawn |= {
        "duration_s": 20.0,
        "altitude_m": 1000.0,
        "vehicles": vehicles,
        "nominal_velocity": [whole(schema.NominalVelocity, from_s=0.0, velocity_ne_m_s=(speed_m_s, 0.0))],
        "limits": {},
        "rates": rates,
        "control": {"loop": "onboard" if onboard else "ground"}
        | (
            {"delay_margin_s": round(0.05 + 1.0 / slower_hz + spread(rng, 0.1, 0.8), 4)}
            if designed
            else {"gains": given}
        ),
        "onboard": whole(
            schema.Onboard, sensor_hz=control_hz, rate_hz=2.0 * control_hz, position_noise_m=0.0, velocity_noise_m_s=0.0
        ),
        "links": {},
        "clocks": {"drift_max_ppm": 20.0},
        "safety": {"setpoint_timeout_s": 30.0, "heartbeat_timeout_s": 30.0, "collision_distance_m": 0.0},
        "monitor": {"act": False, "time_scales": [1.0]},
        "dynamics": "double_integrator",
    }
    drawn.pop("response", None)
    ratio = one_of(rng, between(rng, 0.3, 0.9), between(rng, 1.1, 1.6))
    return Experiment(valid(drawn), margin_ratio=ratio, allow_unstable=chance(rng, 0.8))
