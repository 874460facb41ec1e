"""The figures of the documentation, from the commands that give them.

Each function runs commands and returns Markdown. Figures that differ from run to run are printed as ranges.
`docs.generate.measurements` lists the functions and says when their figures are compared.
"""

import json
import re
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import numpy as np

from docs.generate.blocks import ROOT, table
from docs.generate.runner import Runner
from docs.generate.sessions import steps_of


def _output(text: str) -> str:
    """The output of a command as a code block, without empty lines."""
    lines = [line.rstrip() for line in text.strip().splitlines()]
    return "\n".join(["```text", *(line for line in lines if line), "```"])


def _ms(seconds: float | None, digits: int = 1) -> str:
    return "no limit" if seconds is None else f"{1e3 * seconds:.{digits}f} ms"


def _range(values: Iterable[float], form: str = ".1f", unit: str = "") -> str:
    """The least and the largest of several values as text, or their common value."""
    known = list(values)
    least, most = format(min(known), form), format(max(known), form)
    return f"{least}{unit}" if least == most else f"{least} to {most}{unit}"


def _changed(runner: Runner, scenario: str, name: str, pattern: str, by: str) -> str:
    """The name of a copy of a scenario in which the only match of the pattern is replaced."""
    text = (ROOT / "scenarios" / f"{scenario}.toml").read_text(encoding="utf-8")
    changed, count = re.subn(pattern, by, text, flags=re.MULTILINE)
    assert count == 1, (scenario, pattern)
    (runner.folder / f"{name}.toml").write_text(changed, encoding="utf-8")
    return f"{name}.toml"


def _shorter(runner: Runner, scenario: str, seconds: float) -> str:
    return _changed(runner, scenario, scenario, r"^duration_s = [\d.]+", f"duration_s = {seconds}")


# --- designs ------------------------------------------------------------------------------------------------------


def design(runner: Runner) -> str:
    return _output(runner.run("gcs design scenarios/triangle5.toml"))


def string_limit(runner: Runner) -> str:
    """What the limit on the growth of spacing errors costs in robustness."""
    rows: list[tuple[str, ...]] = []
    for limit in (1, 2):
        name = _changed(
            runner, "triangle5", f"string{limit}", r"^\[control\]", f"[control]\nstring_peak_max = {limit}.0"
        )
        found = runner.json(f"gcs design {name}")
        cells = _ms(found["delay_margin_s"]), f"{found['alpha']:.4f}", f"{found['behaviour']['string_peak']:.3f}"
        rows.append((f"{limit}", *cells))
    head = ("`string_peak_max`", "delay margin, sampled", "alpha", "largest growth from vehicle to vehicle")
    return f"`string1.toml` and `string2.toml` are `triangle5.toml` with `string_peak_max`:\n\n{table(head, rows)}"


def compare(runner: Runner) -> str:
    routes = runner.json("gcs compare scenarios/triangle5.toml --no-sizes")["routes"]
    values: dict[str, Callable[[dict[str, Any]], str]] = {
        "settling time": lambda route: f"{route['settling_time_s']:.2f} s",
        "overshoot": lambda route: f"{route['overshoot']:.0%}",
        "control effort": lambda route: f"{float(format(route['effort_m2_s3'], '.3g')):,.0f} m²/s³",
        "delay margin, sampled": lambda route: _ms(route["delay_margin_s"], 0),
        "alpha of the whole formation": lambda route: f"{route['alpha']:.3f}",
    }
    rows = [(name, *(value(route) for route in routes)) for name, value in values.items()]
    return table(("", *(route["method"] for route in routes)), rows)


def design_time(runner: Runner) -> str:
    """Time of designs of growing chains, as ratios to inclusion of five vehicles in the same run."""
    runner.run("gcs compare scenarios/triangle5.toml --out runs/compare")
    grown = json.loads((runner.folder / "runs" / "compare" / "compare.json").read_text(encoding="utf-8"))["sizes"]
    least_s = next(each["design_s"] for each in grown if each["method"] == "inclusion" and each["vehicles"] == 5)
    sizes = sorted({each["vehicles"] for each in grown})
    times = {(each["method"], each["vehicles"]): each["design_s"] / least_s for each in grown}
    methods = list(dict.fromkeys(each["method"] for each in grown))
    rows = [
        (method, *(f"{times[method, size]:.2g}" if (method, size) in times else "" for size in sizes))
        for method in methods
    ]
    head = ("method", *(f"{size} vehicles" for size in sizes))
    return f"Inclusion takes {least_s:.2f} s for five vehicles; the others as multiples of that:\n\n{table(head, rows)}"


def margin_held(runner: Runner) -> str:
    return _output(runner.run("gcs margin docs/models/held.json"))


def margin_thesis(runner: Runner) -> str:
    return _output(runner.run("gcs margin scenarios/thesis_delay.toml"))


# --- prediction ---------------------------------------------------------------------------------------------------


def prediction_windows(runner: Runner) -> str:
    """The loop delays between which triangle5 is stable, for several assumed ones."""

    def span(ends_s: tuple[float, float | None]) -> str:
        return f"{1e3 * ends_s[0]:.1f} to {_ms(ends_s[1])}"

    rows: list[tuple[str, ...]] = []
    for assumed_s in (0.3, 0.6, 1.5, 3.0):
        name = _predicting(runner, f"assumed{1e3 * assumed_s:.0f}", f"{assumed_s}")
        found = runner.json(f"gcs design {name}")["prediction"]
        windows = found["mismatch_window_s"], found["mismatch_window_continuous_s"]
        rows.append((_ms(assumed_s, 0), *map(span, windows), f"±{_ms(found['jump_s'], 0)}"))
    head = ("assumed loop delay", "stable between", "continuous model", "set-points that jump")
    return f"Each file is `triangle5.toml` with `prediction` in s:\n\n{table(head, rows)}"


def prediction_price(runner: Runner) -> str:
    """The longest loop delay at equal decay and string peak, with and without prediction, and what that costs."""
    rows: list[tuple[str, ...]] = []
    for way in runner.json("gcs design scenarios/triangle5.toml --compare-prediction")["ways"]:
        shorter_s, longer_s = (way["stable_s"][0] - way["loop_delay_s"], way["stable_s"][1] - way["loop_delay_s"])
        half_way_1_s = way["decay_rate_half_way_1_s"]
        rows.append(
            (
                "off" if not way["prediction"] else f"on, ±{way['tolerated']:.0%} wanted",
                way["gains"],
                f"{-way['K1']:.2f}, {way['K2']:.2f}, {way['K3']:.2f}",
                _ms(way["loop_delay_s"]),
                f"{way['ratio']:.2f}",
                f"{1e3 * shorter_s:+.0f} / {1e3 * longer_s:+.0f} ms",
                f"{way['decay_rate_1_s']:.3f} 1/s",
                "–" if half_way_1_s is None else f"{half_way_1_s:.2f} 1/s",
                f"{way['string_peak']:.2f}",
                f"{way['alpha']:.3f}",
                f"{way['spacing_gain_s2']:.2f} s²",
                f"{way['noise_gain']:.2f}",
            )
        )
    head = ("prediction", "gains", "k1, k2, k3", "largest loop delay", "ratio", "mismatch tolerated", "decay")
    return table((*head, "decay half-way", "string peak", "alpha", "disturbance gain", "noise gain"), rows)


def prediction_flights(runner: Runner) -> str:
    """triangle5 over links whose loop delay is five times its margin, with and without prediction."""
    rows: list[tuple[str, ...]] = []
    for name, prediction in (("predicted", '"measured"'), ("plain", '"off"')):
        text = (runner.folder / _predicting(runner, name, prediction)).read_text(encoding="utf-8")
        (runner.folder / f"{name}.toml").write_text(text.replace("delay_s = 0.02", "delay_s = 0.75"), encoding="utf-8")
        flight = runner.json(f"gcs fly {name}.toml --virtual", wanted=(0, 1))
        settled_s = flight["settling_time_s"]
        settled = "not settled" if settled_s is None else f"settled after {settled_s:.1f} s"
        outcome = (
            f"{flight['verdict']}, {settled}" if settled_s is not None else f"{flight['verdict']}: {flight['reason']}"
        )
        rows.append((f"`{prediction}`", outcome, _ms(flight["loop_delay_s"]["p50"]), f"{flight['headroom_min']:.0%}"))
    head = ("`prediction`", "flight", "loop delay, median", "least headroom")
    return f"Both files are `triangle5.toml` with `delay_s = 0.75` each way:\n\n{table(head, rows)}"


def _predicting(runner: Runner, name: str, prediction: str) -> str:
    return _changed(runner, "triangle5", name, r"^\[control\]", f"[control]\nprediction = {prediction}")


# --- where formations break ---------------------------------------------------------------------------------------


def _onset(runner: Runner, scenario: str, options: str) -> dict[str, Any]:
    return runner.json(f"gcs stress scenarios/{scenario}.toml --onset{options}")


def onset_chain3(runner: Runner) -> str:
    onset = _onset(runner, "chain3", "")["onset"]
    return (
        f"The delay margin of `chain3` is **{_ms(onset['predicted_s'], 2)}** of loop delay. In flight, its errors stop "
        f"dying away at **{_ms(onset['loop_delay_s'], 2)}**, {100 * onset['difference']:+.3f} % from that."
    )


_ONSETS = {
    "chain3": "",
    "triangle5": "",
    "chain20": "",
    "chain3_bidirectional": "",
    "thesis_gains": "",
    "thesis_delay": "",
    "chain3_bidirectional onboard": " --loop onboard",
    "chain3 onboard": " --loop onboard",
}


def onsets(runner: Runner) -> str:
    """Onsets in flight of several formations, beside the margins of their designs."""
    rows: list[tuple[str, ...]] = []
    for name, options in _ONSETS.items():
        result = _onset(runner, name.split()[0], options)
        onset, curve = result["onset"], result["curve_error"]
        if onset is None:
            none = "none, as predicted" if result["onset_missing_as_predicted"] else "not found"
            cells = ("no limit", none, "")
        else:
            cells = (_ms(onset["predicted_s"], 2), _ms(onset["loop_delay_s"], 2), f"{100 * onset['difference']:+.3f} %")
        rows.append((f"`{name.split()[0]}`{options.replace(' --loop', ', loop')}", *cells, _share(curve)))
    return table(("scenario", "sampled margin", "onset in flight", "difference", "curve"), rows)


_ONE_LINK = (("triangle5", 5), ("chain3_bidirectional", 1), ("chain3_bidirectional", 2), ("chain3_bidirectional", 3))


def one_link(runner: Runner) -> str:
    """Where formations break if the link of one vehicle alone is slowed."""
    rows: list[tuple[str, ...]] = []
    for name, vehicle in _ONE_LINK:
        result = runner.json(f"gcs stress scenarios/{name}.toml --onset-of {vehicle}")
        onset, curve = result["onset"], result["curve_error"]
        cells = (_ms(onset["predicted_s"], 2), _ms(onset["loop_delay_s"], 2), f"{100 * onset['difference']:+.3f} %")
        left = _ms(onset["link_delay_left_s"], 1)
        rows.append((f"`{name}`", str(vehicle), _ms(result["delay_margin_s"]), *cells, _share(curve), left))
    head = ("scenario", "vehicle", "margin", "predicted", "onset in flight", "difference", "curve", "link takes more")
    return table(head, rows)


def _share(curve: float | None) -> str:
    if curve is None:
        return ""
    return "< 0.001 %" if curve < 1e-5 else f"{100 * curve:.2g} %"


def onset_real_time(runner: Runner) -> str:
    result = _onset(runner, "chain3", " --real-time --assert-onset 0.03")
    onset, late_s = result["onset"], result["noise"]["lateness_s_p99"]["median"]
    return (
        f"Sampled margin {_ms(onset['predicted_s'])}, onset in flight {_ms(onset['loop_delay_s'])}, "
        f"{100 * onset['difference']:+.2f} % from it. Set-points were up to {_ms(late_s, 2)} late (p99, median flight)."
    )


_MAPS = {
    "jitter each way": ("chain3", "--delay 0.21:0.33:5 --jitter 0.04,0.08 --seeds 3", "jitter", "±{} ms"),
    "loss each way": ("chain3", "--delay 0.18:0.3:5 --loss 0.2,0.4 --seeds 2", "loss", "{} %"),
    "control rate": ("triangle5", "--delay 0.15:0.3:6 --rate 10,20,50", "rate", "{} Hz"),
}  # fmt: skip


def maps(runner: Runner) -> str:
    """The link delay at which growth is zero, measured and predicted, for values of a second quantity."""
    tables: list[str] = []
    for title, (scenario, axes, name, form) in _MAPS.items():
        points = runner.json(f"gcs stress scenarios/{scenario}.toml {axes}")["points"]
        values = sorted({point["coordinates"][name] for point in points})
        shown = {"jitter": 1e3, "loss": 1e2, "rate": 1.0}[name]
        rows = [
            (row, *(_crossing(points, name, value, field) for value in values))
            for row, field in (("in flight", "growth_1_s"), ("predicted", "predicted_growth_1_s"))
        ]
        tables.append(table((title, *(form.format(f"{shown * value:g}") for value in values)), rows))
    return "\n\n".join(["Link delay, up and down together, at which the errors stop dying away:", *tables])


def _crossing(points: list[dict[str, Any]], name: str, value: float, field: str) -> str:
    """Where the mean growth over the seeds passes zero, by a straight line between two delays."""
    chosen = [p for p in points if p["coordinates"][name] == value and p["kind"] == "probe" and p[field] is not None]
    delays = sorted({point["coordinates"]["delay"] for point in chosen})
    growth = [np.mean([p[field] for p in chosen if p["coordinates"]["delay"] == delay]) for delay in delays]
    for (left, low), (right, high) in pairwise(zip(delays, growth, strict=True)):
        if low < 0.0 <= high:
            return f"{1e3 * (left + (right - left) * low / (low - high)):.0f} ms"
    return "not within"


# --- flights in real time -----------------------------------------------------------------------------------------


def _flight(runner: Runner, command: str) -> dict[str, Any]:
    """A flight's summary, with its errors against the truth as `gcs grade` finds them."""
    folder = runner.folder / "runs" / "flight"
    if folder.exists():
        folder.rename(runner.folder / "runs" / f"flight{len(list((runner.folder / 'runs').iterdir()))}")
    summary = runner.json(f"{command} --listen 127.0.0.1:0 --out runs/flight", wanted=(0, 1))
    return summary | {"grade": runner.json("gcs grade runs/flight")}


def _readme(runner: Runner, wanted: str) -> list[str]:
    """What the README's command that contains `wanted` prints, with the README's scenario."""
    steps = steps_of(ROOT / "README.md")
    for step in steps:
        if step.file:
            (runner.folder / step.file).write_text(step.text, encoding="utf-8")
    [command] = [step.text.strip() for step in steps if wanted in step.text and not step.file]
    return runner.run(command).splitlines()


def readme_fly(runner: Runner) -> str:
    """The verdict, delay and punctuality; not the lines of the flight, the table of the vehicles and the files."""
    lines = _readme(runner, "gcs fly")
    wanted = ("verdict", "delay", "control")
    return _output("\n".join(line for line in lines if line.startswith(wanted)))


def readme_onset(runner: Runner) -> str:
    """What was found, without the files after it."""
    lines = _readme(runner, "gcs stress")
    return _output("\n".join(lines[: next(k for k, line in enumerate(lines) if line.startswith("files"))]))


def flights(runner: Runner) -> str:
    rows: list[tuple[str, ...]] = []
    for name, seconds, times in (("triangle5", 12.0, 6), ("chain20", 20.0, 1)):
        file = _shorter(runner, name, seconds)
        found = [_flight(runner, f"gcs fly {file}") for _ in range(times)]
        delays = [summary["loop_delay_s"] for summary in found]
        grades = [summary["grade"] for summary in found]
        stable = sum(summary["verdict"] == "stable" for summary in found)
        rows.append(
            (
                f"`{name}`, {times} × {seconds:g} s, {stable} stable",
                _range((1e3 * delay["p50"] for delay in delays), unit=" ms"),
                _range((1e3 * delay["p99"] for delay in delays), unit=" ms"),
                _range((1e3 * grade["loop_delay"]["error_p50_s"] for grade in grades), ".2f", " ms"),
                _range((1e3 * grade["loop_delay"]["error_p99_s"] for grade in grades), ".2f", " ms"),
                _range((1e3 * grade["rtt"]["error_p50_s"] for grade in grades), ".2f", " ms"),
                _range((summary["control"]["deadline_misses"] for summary in found), "d"),
            )
        )
    head = ("flights", "loop delay p50", "p99", "its error p50", "p99", "RTT error p50", "deadline misses")
    return f"The files are those of `scenarios`, with these durations:\n\n{table(head, rows)}"


def too_late(runner: Runner) -> str:
    summary = _flight(runner, "gcs fly scenarios/triangle5.toml --link-delay 0.4")
    return (
        f"Loop delay {_ms(summary['loop_delay_s']['p50'], 0)} at the median, margin {_ms(summary['delay_margin_s'])}: "
        f"{summary['verdict']}, after {summary['duration_s']:.1f} s ({summary['reason']})."
    )


def punctuality(runner: Runner) -> str:
    rows: list[tuple[str, ...]] = []
    for count, option in ((5, ""), (20, ""), (250, ""), (250, " --one-port"), (1000, ""), (1000, " --one-port")):
        found = runner.json(f"gcs bench scenarios/triangle5.toml --real-time --seconds 20 --vehicles {count}{option}")
        cells = [
            f"{1e3 * found[name]['error_p50_s']:.3f} / {1e3 * found[name]['error_p99_s']:.2f}"
            for name in ("link_delay", "loop_delay", "rtt")
        ]
        late, misses = found["control"]["lateness_s"], found["control"]["deadline_misses"]
        cells.append(f"{1e3 * late['p50']:.2f} / {1e3 * late['p99']:.2f}")
        rows.append(
            (f"{count}{', one port per network' if option else ''}", *cells, f"{misses} of {found['control']['ticks']}")
        )
    head = ("vehicles, 50 Hz", "emulated link delay", "loop delay", "round trip", "set-points late", "deadline misses")
    return f"Errors at the median / 99th percentile, ms:\n\n{table(head, rows)}"


def thesis_flights(runner: Runner) -> str:
    points = runner.json("gcs stress scenarios/thesis_delay.toml --delay 0.16,0.9,1.1")["points"]
    probes, own = ([point for point in points if point["kind"] == kind] for kind in ("probe", "own"))
    rows = [
        (
            _ms(flown["coordinates"]["delay"], 0),
            _ms(flown["loop_delay_s"], 0),
            flown["verdict"],
            f"{flown['spacing_error_max_m']:.0f} m",
            f"{probe['growth_1_s']:+.3f} 1/s",
            f"{probe['predicted_growth_1_s']:+.3f} 1/s",
        )
        for probe, flown in zip(probes, own, strict=True)
    ]
    head = ("link delay, up + down", "loop delay p50", "verdict", "largest spacing error", "growth", "predicted")
    return table(head, rows)


def copters(runner: Runner) -> str:
    found = runner.json("gcs fly scenarios/copters5.toml --listen 127.0.0.1:0", wanted=(0, 1))
    response = found["response"]
    lags = [vehicle["lag_s"] for vehicle in response["vehicles"]]
    return (
        f"Lag identified: {_range(lags, '.3f', ' s')}; the scenario's simulated copters have 0.150 s. Delay margin "
        f"{_ms(found['delay_margin_s'], 0)}; {_ms(response['delay_margin_at_once_s'], 0)} if they responded at once."
    )


_RESPONSES = {
    "lag": "lag_s = 0.125\nvelocity_gain_1_s = 2.78",
    "lag with dead time": "lag_s = 0.066\nvelocity_gain_1_s = 1.88\ndead_time_s = 0.048",
    "second order": "lag_s = 0.11\nvelocity_gain_1_s = 1.71\nnatural_frequency_rad_s = 14.0",
}
"""Three models of one ArduCopter's response, fitted to the same measurement."""
_LIMITS = "acceleration_max_m_s2 = 2.5\njerk_max_m_s3 = 5.0"


def copters_onset(runner: Runner) -> str:
    """Where copters of each response model break, beside the margin computed with the response identified in flight."""
    rows: list[tuple[str, ...]] = []
    for model, keys in _RESPONSES.items():
        shown, name = f"`{keys}`".replace("\n", "`, `"), model.replace(" ", "-")
        file = _changed(runner, "copters5", name, r"^lag_s = .*\nvelocity_gain_1_s = .*$", f"{keys}\n{_LIMITS}")
        found = runner.json(f"gcs stress {file} --onset")
        onset, vehicles = found["onset"], found["response"]["vehicles"]
        assert {own["model"] for own in vehicles} == {model}
        lags, margin_s = _range((own["lag_s"] for own in vehicles), ".4f", " s"), onset["predicted_s"]
        flown_s = onset["loop_delay_s"]
        rows.append((f"`{file}`", shown, lags, _ms(margin_s), _ms(flown_s), f"{flown_s / margin_s:.3f}"))
    head = ("file", "`[autopilot]`", "lag identified", "margin computed with it", "onset in flight", "ratio")
    limits = f"`{_LIMITS}`".replace("\n", "` and `")
    return f"Each file is `copters5.toml` with other keys under `[autopilot]`, and {limits}:\n\n{table(head, rows)}"


def signing(runner: Runner) -> str:
    """What signing costs on a link that reorders, and in computing time."""
    runner.run("gcs key formation.key")
    rows: list[tuple[str, ...]] = []
    file = _shorter(runner, "wifi_bursts", 20.0)
    for how, option in (("unsigned", ""), ("signed", " --key formation.key")):
        found = runner.json(f"gcs fly {file} --listen 127.0.0.1:0{option}", wanted=(0, 1))
        received = sum(vehicle["received"] for vehicle in found["vehicles"])
        refused = sum(found["refused"].values())
        rows.append((how, f"{refused / (received + refused):.1%}", _ms(found["loop_delay_s"]["p99"], 0)))
    cost = runner.json("gcs bench scenarios/triangle5.toml --signed")["signed"]
    text = f"Step by step, a signed flight in virtual time takes {cost['time_ratio_p50']:.2f} times as long to compute."
    return f"{table(('`wifi_bursts`, 20 s', 'frames refused by the station', 'loop delay p99'), rows)}\n\n{text}"


# --- capacity and speed -------------------------------------------------------------------------------------------


def capacity(runner: Runner) -> str:
    rows: list[tuple[str, ...]] = []
    for found in runner.json("gcs capacity scenarios/radio57600.toml")["capacities"]:
        most, following = found["most"], found["next"]
        delays = f"{1e3 * most['loop_delay_p50_s']:.0f} / {1e3 * most['loop_delay_p99_s']:.0f} ms"
        ends = found["failed"] if following is None else f"{following['vehicles']} vehicles: {following['reason']}"
        rows.append((f"{found['rate_hz']:g} Hz", f"{most['vehicles']}", delays, ends))
    return table(("telemetry and control", "vehicles carried", "loop delay p50 / p99", "what ends it"), rows)


def speed(runner: Runner) -> str:
    rows: list[tuple[str, ...]] = []
    for options in ("", " --vehicles 20", " --vehicles 60", " --vehicles 250"):
        found = runner.json(f"gcs bench scenarios/triangle5.toml{options}")
        both = found["real_time_factor_p50"], found["real_time_factor"]
        flown = _range([found["vehicles"] * factor for factor in both], ".0f", "")
        station = f"{1e3 * found['station_s_per_tick']:.2f} ms"
        rows.append((f"{found['vehicles']}", _range(both, ".3g", " times"), flown, station))
    head = (
        "vehicles, 50 Hz", "faster than real time, one core (median to best)", "vehicle-seconds in a second",
        "station, of its period of 20 ms",
    )  # fmt: skip
    return table(head, rows)


def map_speed(runner: Runner) -> str:
    """How fast one process flies and judges the trials of maps."""
    rows: list[tuple[str, ...]] = []
    for vehicles, options in (
        (5, "triangle5.toml --delay 0.02:0.3:15 --seeds 4"),
        (20, "chain20.toml --delay 0.02:0.28:8 --seeds 2"),
        (5, "triangle5.toml --delay 0.05:0.25:5 --jitter 0.01,0.03 --seeds 4"),
    ):
        out = f"runs/map{len(rows) + 1}"
        runner.run(f"gcs stress scenarios/{options} --workers 1 --out {out}")
        trials = [json.loads(line) for line in (runner.folder / out / "trials.jsonl").read_text("utf-8").splitlines()]
        figures = [f"`{options.partition(' ')[2].rpartition(' --seeds')[0]}`", f"{vehicles}", f"{len(trials)}"]
        for kinds in (("probe",), ("own",), ("probe", "own")):
            own = [trial for trial in trials if trial["kind"] in kinds]
            flown_s = vehicles * sum(len(trial["trace_m"]) * trial["trace_period_s"] for trial in own)
            figures.append(f"{flown_s / sum(trial['elapsed_s'] for trial in own):.0f}")
        rows.append(tuple(figures))
    return table(("map", "vehicles", "trials", "probes", "own trials", "both"), rows)
