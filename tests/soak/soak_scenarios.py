"""Random scenarios for the soak.

One function here draws each part of the schema, through `whole`, which fails if a key of the schema is not drawn: a new
key must be added here too. Bounds that matter are read from the schema.
"""

import math

import numpy as np

from scenarios import schema
from scenarios.keys import disturbance as disturbance_keys
from scenarios.keys import link as link_keys
from scenarios.schema import Scenario
from tests.soak.soak_draws import Part, Rng, between, chance, most_of, one_of, some, spread, whole

VEHICLE_TICKS = 6_000
"""Largest number of control and telemetry ticks of all vehicles of a flight, unless the shortest flight needs more."""
SHORTEST_S, LONGEST_S = 4.0, 12.0
MOST_VEHICLES = 12
AUTOPILOT_START_S = 25.0
"""Time for take-off and identification in the budget of ticks."""


def random_scenario(rng: Rng, name: str) -> Part:
    autopilot = chance(rng, 0.2)
    count = int(min(MOST_VEHICLES, 1 + rng.poisson(3.0)))
    onboard = not autopilot and chance(rng, 0.3)
    rates = _rates(rng, onboard=onboard, autopilot=autopilot)
    ticks_1_s = 0.5 * count * (rates["control_hz"] + rates["telemetry_hz"])
    budget_s = VEHICLE_TICKS / ticks_1_s - (AUTOPILOT_START_S if autopilot else 1.0)
    duration_s = round(min(between(rng, SHORTEST_S, LONGEST_S), max(budget_s, SHORTEST_S)), 1)
    pitch_m = spread(rng, 8.0, 40.0) if autopilot else spread(rng, 15.0, 300.0)
    speed_m_s = spread(rng, 1.2, 5.0) if autopilot else spread(rng, 15.0, 120.0)
    limits = _limits(rng, speed_m_s)
    vehicles = random_vehicles(rng, count, pitch_m, speed_m_s, autopilot=autopilot)
    control = _control(rng, vehicles, rates, onboard=onboard, autopilot=autopilot)
    if control.get("method", "inclusion") == "inclusion" or control.get("blocks"):
        for vehicle in vehicles:
            vehicle.pop("hears", None)
    drawn = whole(
        Scenario,
        name=name,
        seed=int(rng.integers(2**31)),
        duration_s=duration_s,
        altitude_m=between(rng, 3.0, 8.0) if autopilot else one_of(rng, 0.0, 1000.0),
        vehicles=vehicles,
        nominal_velocity=_nominal_velocity(rng, speed_m_s, duration_s, limits),
        course=None,
        formation_changes=None,
        limits=limits,
        rates=rates,
        control=control,
        onboard=_onboard(rng, rates["control_hz"]),
        links=_links(rng, [vehicle["system_id"] for vehicle in vehicles], duration_s),
        clocks=_clocks(rng),
        safety=_safety(rng, pitch_m),
        monitor=_monitor(rng),
        dynamics="autopilot" if autopilot else "double_integrator",
        autopilot=_autopilot(rng, duration_s),
        response=_response(rng) if autopilot and chance(rng, 0.6) else None,
        disturbance=None,
        navigation=None,
        code=None,
        at_end=one_of(rng, "hold", "land"),
    )
    drawn |= _disturbed(np.random.default_rng((drawn["seed"], 1)))
    uneven = onboard and max(rates["control_hz"], rates["telemetry_hz"]) % min(
        rates["control_hz"], rates["telemetry_hz"]
    )
    if not uneven and (not autopilot or "response" in drawn):  # uneven rates on board: windows take minutes
        fast = max(rates.values()) > 100.0  # the windows of a whole schedule take half a minute
        own = np.random.default_rng(drawn["seed"])
        if not autopilot:
            control["execute_at"] = chance(np.random.default_rng((drawn["seed"], 2)), 0.15)
        _predict(own, control, measured=0.5 if fast else "measured", fed=not autopilot and not onboard)
        rates["target_hz"] = one_of(own, 10.0, 10.0, 0.0, rates["control_hz"])
    return drawn


def _disturbed(rng: Rng) -> Part:
    """Wind, gusts and errors of navigation, with random numbers of their own: all else is as without them.

    They stay small beside the spacing: the soak judges formations by whether their errors settle.
    """
    gusts = whole(
        disturbance_keys.Gusts,
        deviation_m_s2=spread(rng, 1e-4, 3e-3),
        correlation_time_s=spread(rng, 0.1, 20.0),
        common=chance(rng, 0.3),
    )
    wind = between(rng, -0.005, 0.005), between(rng, -0.005, 0.005)
    air = whole(disturbance_keys.Disturbance, wind_ne_m_s2=wind, gusts=some(rng, 0.7, gusts), sector=None)
    navigation = whole(
        disturbance_keys.Navigation,
        position_noise_m=spread(rng, 1e-4, 1e-3),
        velocity_noise_m_s=spread(rng, 1e-4, 1e-3),
        position_bias_m=spread(rng, 1e-4, 1e-2),
        velocity_bias_m_s=spread(rng, 1e-5, 1e-3),
        bias_time_s=spread(rng, 1.0, 100.0),
    )
    found = {"disturbance": some(rng, 0.15, air), "navigation": some(rng, 0.15, navigation)}
    return {name: part for name, part in found.items() if part is not None}


def _predict(rng: Rng, control: Part, *, measured: float | str, fed: bool) -> None:
    """Prediction and feed-forward, with random numbers of their own: all else is as without them."""
    if chance(rng, 0.15):
        control["prediction"] = one_of(rng, measured, spread(rng, 0.02, 1.0))
    if fed and "gains" in control and chance(rng, 0.2):
        control["feed_forward"] = between(rng, 0.0, 1.0)


def random_vehicles(rng: Rng, count: int, pitch_m: float, speed_m_s: float, *, autopilot: bool) -> list[Part]:
    """A tree of any shape. Its places are on a grid, so that no two coincide."""
    ids = rng.choice(np.arange(1, 251), size=count, replace=False).tolist() if chance(rng, 0.5) else range(1, count + 1)
    side = max(2, math.ceil(1.5 * math.sqrt(count)))
    cells = rng.choice(side * side, size=count, replace=False)
    place = pitch_m * (np.stack([-(cells // side), cells % side], axis=1) + rng.uniform(-0.2, 0.2, (count, 2)))
    error_m = rng.normal(size=(count, 2)) * pitch_m * one_of(rng, 0.0, 0.02, 0.1)
    error_m_s = rng.normal(size=(count, 2)) * speed_m_s * one_of(rng, 0.0, 0.02, 0.1)
    shape = one_of(rng, "chain", "star", "any")
    vehicles: list[Part] = []
    for k, system_id in enumerate(ids):
        ahead = {"chain": k - 1, "star": 0, "any": int(rng.integers(max(k, 1)))}[shape]
        others = [other for j, other in enumerate(ids) if k and j not in (k, ahead) and chance(rng, 0.3)]
        velocity = (0.0, 0.0) if autopilot else np.round((speed_m_s, 0.0) + error_m_s[k], 4).tolist()
        vehicles.append(
            whole(
                schema.Vehicle,
                system_id=int(system_id),
                follows=None if k == 0 else vehicles[ahead]["system_id"],
                offset_ne_m=None if k == 0 else np.round(place[k] - place[ahead], 3).tolist(),
                hears=others or None,
                position_ne_m=np.round(place[k] + error_m[k], 3).tolist(),
                velocity_ne_m_s=velocity,
                altitude_m=None,  # the soak judges horizontal distances
                flavour=one_of(rng, None, "ardupilot", "px4") if autopilot else None,
            )
        )
    return [vehicles[k] for k in rng.permutation(count)]


def _nominal_velocity(rng: Rng, speed_m_s: float, duration_s: float, limits: Part) -> list[Part]:
    entries = [whole(schema.NominalVelocity, from_s=0.0, velocity_ne_m_s=(speed_m_s, 0.0))]
    while chance(rng, 0.25):
        from_s = round(entries[-1]["from_s"] + between(rng, 0.1, duration_s), 3)
        angle, length = rng.uniform(-0.5, 0.5), speed_m_s * rng.uniform(0.9, 1.1)
        length = min(max(length, 1.001 * limits["speed_min_m_s"]), 0.999 * limits.get("speed_max_m_s", 1e4))
        velocity = round(length * math.cos(angle), 6), round(length * math.sin(angle), 6)
        entries.append(whole(schema.NominalVelocity, from_s=from_s, velocity_ne_m_s=velocity))
    return entries


def _limits(rng: Rng, speed_m_s: float) -> Part:
    return whole(
        schema.Limits,
        speed_min_m_s=spread(rng, 0.1, 0.4 * speed_m_s),
        speed_max_m_s=some(rng, 0.4, round(speed_m_s * between(rng, 1.6, 4.0), 3)),
        acceleration_max_m_s2=some(rng, 0.4, spread(rng, 0.5, 100.0)),
        turn_rate_max_rad_s=some(rng, 0.3, spread(rng, 0.05, 3.0)),
    )


def _rates(rng: Rng, *, onboard: bool, autopilot: bool) -> Part:
    control_hz = one_of(rng, 50.0, 50.0, 50.0, 10.0, 20.0, 25.0, spread(rng, 1.0, 500.0), float(rng.integers(1, 100)))
    if onboard:  # the rates of the sensor and the onboard loop are whole multiples of it
        control_hz = one_of(rng, 5.0, 10.0, 20.0, 25.0, 50.0, 100.0)
    if autopilot:
        control_hz = one_of(rng, 10.0, 25.0, 50.0, between(rng, 5.0, 60.0))
    any_hz = spread(rng, 1.0, 100.0 if autopilot else 500.0)
    return whole(
        schema.Rates,
        control_hz=control_hz,
        telemetry_hz=one_of(rng, control_hz, control_hz, control_hz, 5.0, 20.0, any_hz),
        timesync_hz=one_of(rng, 10.0, 10.0, 10.0, spread(rng, 0.5, 50.0)),
        target_hz=None,  # see _predict
    )


def _onboard(rng: Rng, control_hz: float) -> Part:
    times = one_of(rng, 1, 1, 2)
    sensor_hz = times * control_hz if times * control_hz <= 250.0 else control_hz
    return whole(
        schema.Onboard,
        sensor_hz=sensor_hz,
        rate_hz=one_of(rng, 1, 2) * sensor_hz if 2.0 * sensor_hz <= 500.0 else sensor_hz,
        position_noise_m=one_of(rng, 0.0, 0.0, spread(rng, 0.001, 1.0)),
        velocity_noise_m_s=one_of(rng, 0.0, 0.0, spread(rng, 0.001, 1.0)),
    )


def fixed_gains(rng: Rng, *, stable: bool, own_1_s: float) -> Part:
    """Gains that are stable without delay, or arbitrary ones."""
    front_1_s, spacing_1_s2 = own_1_s * rng.uniform(0.0, 0.5), own_1_s**2 * spread(rng, 0.02, 0.6)
    any_gains = [one_of(rng, -1.0, 1.0) * spread(rng, 1e-3, 1e5) for _ in range(3)]
    if not stable:
        own_1_s, front_1_s, spacing_1_s2 = one_of(
            rng,
            (-own_1_s, front_1_s, spacing_1_s2),
            (own_1_s, front_1_s, -spacing_1_s2),
            (own_1_s, front_1_s, 0.0),
            any_gains,
            any_gains,
        )
    return whole(schema.FixedGains, K1=round(-own_1_s, 5), K2=round(front_1_s, 5), K3=round(spacing_1_s2, 6))


def _control(rng: Rng, vehicles: list[Part], rates: Part, *, onboard: bool, autopilot: bool) -> Part:
    way = one_of(rng, "gains", "gains", "gains", "blocks", "required", "required", "graph")
    if autopilot and way in ("blocks", "graph"):
        way = "gains"
    margin_s = round(1.0 / rates["control_hz"] + spread(rng, 0.1, 2.0), 4)
    required = way in ("required", "graph")
    return whole(
        schema.Control,
        method=one_of(rng, "graph-lqr", "graph-dk") if way == "graph" else "inclusion",
        loop="onboard" if onboard else "ground",
        delay_margin_s=some(rng, 0.6, margin_s) if required else None,
        alpha=some(rng, 0.2, spread(rng, 0.01, 0.9)) if required else None,
        decay_rate_1_s=some(rng, 0.2, spread(rng, 0.01, 2.0)) if required else None,
        string_peak_max=one_of(rng, 1.0, 1.0, between(rng, 1.0, 2.0)),
        execute_at=None,  # drawn later, as are the next two
        feed_forward=None,
        prediction=None,
        for_link=None,  # the search for gains takes seconds
        link_headroom=None,
        controller=None,
        linear=None,
        criteria=None,  # their search takes longer than the flight
        overlap=some(np.random.default_rng(vehicles[0]["system_id"]), 0.3, _overlap(way)),
        gains=fixed_gains(rng, stable=chance(rng, 0.93), own_1_s=spread(rng, 0.2, 6.0)) if way == "gains" else None,
        blocks=_blocks(rng, vehicles) if way == "blocks" else None,
    )


def _overlap(way: str) -> Part | None:
    return whole(schema.Overlap, ahead=2, behind=True, leader=True) if way == "graph" else None


def _blocks(rng: Rng, vehicles: list[Part]) -> list[Part]:
    """Stable gains on the tree, and weak ones on other pairs."""
    gains = fixed_gains(rng, stable=True, own_1_s=spread(rng, 0.2, 6.0))
    follows = {vehicle["system_id"]: vehicle.get("follows") for vehicle in vehicles}
    pairs: dict[tuple[int, int], tuple[float, float]] = {}
    for own, ahead in follows.items():
        pairs[own, own] = (gains["K3"], gains["K1"])
        if ahead is not None:
            pairs[own, ahead] = (0.0, gains["K2"])
    for own in follows:
        for other in follows:
            if (own, other) not in pairs and chance(rng, 0.1):
                pairs[own, other] = (0.05 * gains["K3"], 0.05 * gains["K1"])

    def gain(of: int, spacing: float, velocity: float) -> list[list[float]]:
        both = [[spacing, 0.0, velocity, 0.0], [0.0, spacing, 0.0, velocity]]
        return both if follows[of] is not None else [row[2:] for row in both]

    return [whole(schema.GainBlock, vehicle=own, of=of, gain=gain(of, *two)) for (own, of), two in pairs.items()]


def _jitter(rng: Rng) -> Part:
    kind = one_of(rng, "uniform", "normal", "exponential", "gamma", "trace")
    scale_s = spread(rng, 1e-4, 0.05)
    trace = [round(value, 5) for value in rng.exponential(scale_s, size=int(rng.integers(1, 20))).tolist()]
    return whole(
        link_keys.Jitter,
        distribution=kind,
        scale_s=scale_s if kind != "trace" else None,
        shape=spread(rng, 0.3, 5.0) if kind == "gamma" else None,
        trace_file=None,  # reading it moves its delays to trace_s
        trace_s=trace if kind == "trace" else None,
    )


def _link(rng: Rng, channels: list[str], duration_s: float, *, calm: bool) -> Part:
    delay_s = one_of(rng, 0.0, between(rng, 0.0, 0.05), between(rng, 0.0, 0.15), spread(rng, 1e-4, 1.0))
    at_s = sorted(between(rng, 0.0, duration_s) for _ in range(int(rng.integers(1, 5))))
    points = [
        whole(link_keys.DelayPoint, at_s=time_s, delay_s=between(rng, 0.0, 0.15)) for time_s in dict.fromkeys(at_s)
    ]
    from_s = between(rng, 0.0, duration_s)
    outage = whole(link_keys.Outage, from_s=from_s, until_s=round(from_s + spread(rng, 0.05, 5.0), 4))
    bursts = whole(
        link_keys.LossBursts,
        to_bad_probability=spread(rng, 0.001, 0.2),
        to_good_probability=spread(rng, 0.05, 1.0),
        loss_good_probability=one_of(rng, 0.0, 0.02),
        loss_bad_probability=one_of(rng, 1.0, 0.5),
    )
    moving, bursty = chance(rng, 0.15), chance(rng, 0.2)
    often = 0.0 if calm else 1.0
    return whole(
        link_keys.Link,
        delay_s=0.0 if moving and not calm else delay_s,
        delay_points=points if moving and not calm else None,
        jitter=some(rng, 0.5 * often, _jitter(rng)),
        reordering=chance(rng, 0.3 * often),
        loss_probability=0.0 if bursty else one_of(rng, 0.0, spread(rng, 0.001, 0.3)) * often,
        loss_bursts=some(rng, often, bursts) if bursty else None,
        duplicate_probability=one_of(rng, 0.0, 0.0, spread(rng, 0.001, 0.2)) * often,
        corrupt_probability=one_of(rng, 0.0, 0.0, spread(rng, 0.001, 0.1)) * often,
        outages=some(rng, 0.15 * often, [outage]),
        channel=one_of(rng, *channels) if channels and chance(rng, 0.7) else None,
    )


def _links(rng: Rng, system_ids: list[int], duration_s: float) -> Part:
    calm = chance(rng, 0.45)
    names = [] if calm or chance(rng, 0.75) else ["a", "b"][: int(rng.integers(1, 3))]
    channels = [_channel(rng, name) for name in names]
    return whole(
        link_keys.Links,
        profile=None,  # reading it replaces the links
        up=_link(rng, names, duration_s, calm=calm),
        down=_link(rng, names, duration_s, calm=calm),
        vehicles=[
            whole(
                link_keys.VehicleLinks,
                system_id=system_id,
                up=some(rng, 0.7, _link(rng, names, duration_s, calm=calm)),
                down=some(rng, 0.7, _link(rng, names, duration_s, calm=calm)),
            )
            for system_id in system_ids
            if chance(rng, 0.15)
        ],
        channels=channels,
        times_from=one_of(rng, "flight", "start"),
        one_port=chance(rng, 0.5),
    )


def _channel(rng: Rng, name: str) -> Part:
    bytes_count = chance(rng, 0.5)
    return whole(
        link_keys.Channel,
        name=name,
        bandwidth_bit_s=spread(rng, 19_200.0, 1e7),
        bits_per_byte=one_of(rng, 8, 10),
        queue_bytes=int(rng.integers(0, 20_000)) if bytes_count else None,
        queue_datagrams=None if bytes_count else int(rng.integers(0, 200)),
        shared=chance(rng, 0.7),
        half_duplex=chance(rng, 0.4),
    )


def _clocks(rng: Rng) -> Part:
    most_ppm = most_of(schema.Clocks, "drift_max_ppm")
    return whole(
        schema.Clocks,
        offset_max_s=one_of(rng, 0.0, 100.0, spread(rng, 1.0, most_of(schema.Clocks, "offset_max_s"))),
        drift_max_ppm=one_of(rng, 0.0, 20.0, 20.0, 20.0, min(300.0, most_ppm), some(rng, 0.3, most_ppm) or 100.0),
    )


def _safety(rng: Rng, pitch_m: float) -> Part:
    return whole(
        schema.Safety,
        setpoint_timeout_s=one_of(rng, 1.0, spread(rng, 0.3, 10.0)),
        ready_patience_s=None,  # long enough for each start
        heartbeat_timeout_s=one_of(rng, 3.0, spread(rng, 1.5, 10.0)),
        spacing_error_limit_m=one_of(rng, 1000.0, round(pitch_m * between(rng, 2.0, 20.0), 2)),
        collision_distance_m=one_of(rng, 0.0, round(pitch_m * between(rng, 0.0, 0.3), 3)),
        settled_fraction=one_of(rng, 0.01, 0.01, spread(rng, 0.005, 0.3)),
    )


def _monitor(rng: Rng) -> Part:
    caution = one_of(rng, 0.3, between(rng, 0.0, 0.9))
    scales = [1.0]
    while chance(rng, 0.35) and len(scales) < 8:
        scales.append(round(scales[-1] * between(rng, 1.2, 3.0), 4))
    return whole(
        schema.Monitor,
        act=chance(rng, 0.7),
        caution_headroom=caution,
        critical_headroom=round(caution - spread(rng, 0.01, 0.5), 4),
        hysteresis=one_of(rng, 0.05, between(rng, 0.0, 0.3)),
        window_s=one_of(rng, 1.0, spread(rng, 0.05, 5.0)),
        hold_s=one_of(rng, 0.3, between(rng, 0.0, 2.0)),
        ease_s=one_of(rng, 3.0, between(rng, 0.0, 3.0)),
        blend_s=one_of(rng, 1.0, spread(rng, 0.01, 3.0)),
        time_scales=scales,
        open_factor=one_of(rng, 1.5, between(rng, 1.0, 3.0)),
        open_s=one_of(rng, 10.0, spread(rng, 0.2, 10.0)),
    )


def _autopilot(rng: Rng, duration_s: float) -> Part:
    jumps = sorted(between(rng, 0.5, AUTOPILOT_START_S + duration_s) for _ in range(int(rng.integers(1, 3))))
    lengths = [one_of(rng, spread(rng, 0.01, 100.0), -between(rng, 0.01, 30.0)) for _ in jumps]
    return whole(
        schema.Autopilot,
        flavour=one_of(rng, "ardupilot", "px4"),
        lag_s=one_of(rng, 0.15, spread(rng, 0.05, 0.5)),
        dead_time_s=None,  # tests of identification fly the other models
        natural_frequency_rad_s=None,
        jerk_max_m_s3=None,
        velocity_gain_1_s=one_of(rng, 2.0, spread(rng, 0.5, 4.0)),
        acceleration_max_m_s2=one_of(rng, 5.0, spread(rng, 2.0, 15.0)),
        speed_max_m_s=one_of(rng, 12.0, between(rng, 8.0, 30.0)),
        drag_1_m=0.0,  # would change what settles; flown in the tests of copters
        climb_max_m_s=one_of(rng, 2.5, between(rng, 2.0, 5.0)),
        telemetry_after_s=between(rng, 0.0, 1.0),
        ready_after_s=between(rng, 0.0, 2.0),
        arming_refusals=one_of(rng, 0, 0, 2),
        origin_spread_m=one_of(rng, 0.0, 20.0),
        clock_jumps=[whole(schema.ClockJump, at_s=at_s, by_s=by_s) for at_s, by_s in zip(jumps, lengths, strict=True)]
        if chance(rng, 0.12)
        else None,
        sitl=None,  # bounds hold only once the errors of stamps have shown
    )


def _response(rng: Rng) -> Part:
    return whole(
        schema.Response,
        dead_time_s=None,
        natural_frequency_rad_s=None,
        lag_s=spread(rng, 0.05, 0.5),
        velocity_gain_1_s=one_of(rng, 0.0, 2.0, spread(rng, 0.5, 4.0)),
    )
