"""Terminal output before and after a flight: the design and the summary."""

from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gcs.control.tick import Mode
from gcs.plan.design import (
    CodeRecord,
    CriteriaPart,
    Design,
    FiguresAtDelay,
    FiguresAtExpectedDelay,
    PredictionPart,
    ResponsePart,
    TradeOffPoint,
    WindowAt,
)
from gcs.runs.record import RECORDING_FILE, STARTED, TICKS_FILE
from gcs.runs.refusals import in_words
from gcs.runs.summary_record import FlownSpread, Summary, VehicleSummary
from gcs.views.console import UNKNOWN, growth_text, ms_text, number_text, plain_console, table_of, vehicles_text
from scenarios.schema import GainBlock

_LOSSY = 0.1
"""Above this share of lost datagrams, gains for measured links are printed with a warning."""
_HASH = 12
"""Number of digits shown of a hash."""


def print_design(design: Design, console: Console | None = None) -> None:
    """Print the gains, the robustness, both margins, and the trade-off between robustness and margin."""
    console = console or plain_console()
    console.print(f"design   {design.method}, loop {design.loop}, period {design.period_s * 1e3:g} ms")
    if design.code:
        console.print(f"code     {_code_text(design.code)}", markup=False)
    if design.margin_unknown:
        console.print(f"margin   unknown: {design.margin_unknown}")
        return
    if design.inclusion_gains is not None and design.behaviour is not None:
        own, front, spacing = (gain[0][0] for gain in design.inclusion_gains)
        followed = f", K2 {front:+.4f} 1/s, K3 {spacing:+.4f} 1/s²" if design.vehicles != 1 else ""
        console.print(f"gains    K1 {own:+.4f} 1/s{followed}")
        fed = f" + {design.feed_forward:g} u_(i-1)" if design.feed_forward else ""
        law = f"u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p{fed}, the leader u_1 = K1 e_1^v, north and east alike"
        console.print(f"         {law if followed else 'u = K1 e^v, north and east alike'}")
        _print_margins(design, console)
        console.print(response_text(design.response), end="")
        alpha, bound, decay_1_s = design.alpha, "robustness bound", design.behaviour.decay_rate_1_s
        if not followed:  # the design's figures are those of a follower; here e' = K1 e + w
            alpha, decay_1_s = max(0.0, -own), -own
    else:
        console.print(table_of(design.blocks, _BLOCK_COLUMNS))
        _print_margins(design, console)
        bound, alpha, decay_1_s = "robustness bound of the whole formation", design.alpha, design.decay_rate_1_s
    loss = "" if design.cost_loss is None else f"; LQR cost {design.cost_loss:.1%} above the centralised optimum"
    console.print(f"alpha    {alpha:.4f} ({bound}), decay {decay_1_s:.2f} 1/s without delay{loss}")
    if design.at_loop_delay is not None:
        _print_figures_at_delay(design.at_loop_delay, console)
    if (whole := design.whole) is not None:
        at = f"{whole.alpha_at_loop_delay:.4f} at {ms_text(whole.loop_delay_s)} of loop delay"
        console.print(
            f"whole    {whole.alpha:.4f} if all vehicles are disturbed together, {at}; alpha is one follower's"
        )
    if design.spread is not None and design.spread.vehicles:
        most = max(design.spread.vehicles, key=lambda own: own.reported_rms_m)
        at = f"at {ms_text(design.spread.loop_delay_s)} of loop delay"
        console.print(
            f"spread   {most.reported_rms_m:.3f} m rms of the spacing error reported by vehicle {most.system_id}, the "
            f"largest, {at}; {most.spacing_error_rms_m:.3f} m of the true one"
        )
    if (link := design.for_link) is not None:
        ends = f"{ms_text(link.loop_delay_s_least)} to {ms_text(link.loop_delay_s_worst)}"
        measured = f"loop delay {ms_text(link.loop_delay_s_p50)} (median), {ends}, measured in {link.source}"
        console.print(f"link     {measured}; wanted headroom {link.headroom:.0%} at the worst")
        console.print(f"         chosen {link.chosen}")
        if link.lost_share > _LOSSY:
            hides = "if set-points are lost as often, the previous one stays in force longer than these delays show"
            console.print(f"losses   {link.lost_share:.0%} of a vehicle's datagrams were lost; {hides}")
    if design.criteria is not None:
        _print_criteria(design.criteria, console)
    if design.trade_off:
        title = "the trade-off" if not design.responses else "the trade-off of vehicles that respond at once"
        console.print(table_of(design.trade_off, _TRADE_OFF_COLUMNS, title=title))


def _print_criteria(found: CriteriaPart, console: Console) -> None:
    at = f"at {ms_text(found.at_delay_s)} of loop delay"
    bound = ""
    if found.alpha_bound:
        share = found.alpha_at_delay / found.alpha_bound
        bound = f", {share:.0%} of {found.alpha_bound:.4f}, which no controller exceeds"
    console.print(
        f"criteria without delay: roots have damping {found.damping:.3f} and natural frequencies up to "
        f"{found.natural_frequency_rad_s:.3f} rad/s"
    )
    bound += ", by the loop in discrete time" if found.discrete else ""
    weight = "" if found.weight == (1.0, 1.0) else f" with W = {found.weight[0]:g}, {found.weight[1]:g}"
    console.print(
        f"         {at}: decay {found.decay_rate_at_delay_1_s:.3f} 1/s, alpha{weight} {found.alpha_at_delay:.4f}{bound}"
    )
    console.print(
        f"         {at}: disturbing acceleration to spacing error {number_text(found.spacing_gain_s2, '.3f')} s², "
        f"noise to command {number_text(found.noise_gain, '.3f')}"
    )
    if found.delays_jumping_s is not None:
        low_s, high_s = found.delays_jumping_s
        console.print(f"         stable for delays that jump between {ms_text(low_s)} and {ms_text(high_s)}")
    if found.delays_covered_by is not None:
        console.print(
            f"         delays asked for: proved by the bound {found.delays_covered_by}, "
            f"up to {ms_text(found.delays_covered_to_s)}"
        )


def _print_margins(design: Design, console: Console) -> None:
    sampled_s, continuous_s = design.delay_margin_s, design.delay_margin_continuous_s
    if design.onboard is not None and sampled_s is None:
        console.print("margin   no limit: no delay of what the station streams makes this loop unstable")
    elif sampled_s == 0.0:
        console.print("margin   none: the sampled loop is unstable without any delay")
    else:
        over, alike = (" over the scenario's links", " if delays were alike") if design.margin_over_links else ("", "")
        console.print(
            f"margin   {ms_text(sampled_s)} of loop delay in the sampled loop{over}, {ms_text(continuous_s)} in the "
            f"continuous model{alike}"
        )
    if design.prediction is not None:
        assumed_s = design.prediction.assumed_delay_s
        over = "the measured loop delay" if assumed_s is None else f"{ms_text(assumed_s)} of loop delay"
        console.print(f"         without prediction; the station predicts over {over}")
        if design.prediction.assumes:
            console.print(f"         and assumes: {design.prediction.assumes}")
        console.print(windows_table(design.prediction))
    if design.vehicles == 1:
        console.print("         of the one vehicle's own velocity loop, as nobody follows it")
    if design.onboard is not None:
        ground_s = design.onboard.ground_delay_margin_s
        console.print(f"         {ms_text(ground_s)} if the station closed every loop with the same gains")


def windows_table(prediction: PredictionPart) -> Table:
    """The mismatch windows of a predicting station, one row for each assumed delay."""
    return table_of(prediction.windows, _WINDOW_COLUMNS, title="stable between, with prediction")


def _end(end_s: float | None) -> str:
    return "no limit" if end_s is None else ms_text(end_s, unit="")


_WINDOW_COLUMNS: dict[str, Callable[[WindowAt], str]] = {
    "assumed, ms": lambda at: ms_text(at.assumed_delay_s, ".0f", unit=""),
    "from, ms": lambda at: _end(at.mismatch_window_s[0]),
    "to, ms": lambda at: _end(at.mismatch_window_s[1]),
    "continuous, from": lambda at: _end(at.mismatch_window_continuous_s[0]),
    "to": lambda at: _end(at.mismatch_window_continuous_s[1]),
    "jump, ±ms": lambda at: ms_text(at.jump_s, ".0f", unit=""),
}


def _print_figures_at_delay(flown: FiguresAtExpectedDelay, console: Console) -> None:
    at = "at the {} of loop delay that the scenario's links give"
    if flown.delays_differ:
        at = "if all vehicles have the {} of loop delay of the slowest"
    console.print(f"         {figures_text(flown, at)}")
    if flown.alpha_kept is None:
        return
    kept = f"at least {flown.alpha_kept:.4f} {_up_to(flown.alpha_kept_to_s)}"
    if flown.string_peak_kept is None:
        console.print(f"         {kept}")
        console.print("string   no verdict: with gains on a general pattern errors do not propagate along a chain")
        return
    until = _up_to(flown.string_peak_kept_to_s)
    console.print(f"         {kept}; {until} spacing errors {growth_text(flown.string_peak_kept)}")


def figures_text(flown: FiguresAtDelay, at: str = "at {} of loop delay") -> str:
    """In words, α at a loop delay and, if spacing errors propagate along a chain, their growth at that delay."""
    delay = at.format(ms_text(flown.loop_delay_s))
    if flown.discrete:
        return f"{flown.alpha:.4f} {delay}, by the loop in discrete time"
    if not flown.has_string_verdict:
        return f"{flown.alpha:.4f} of the whole formation {delay}"
    return f"{flown.alpha:.4f} {delay}, where spacing errors {growth_text(flown.string_peak)} from vehicle to vehicle"


def _up_to(delay_s: float | None) -> str:
    if delay_s is None:
        return "at every loop delay"
    return "at no loop delay" if delay_s == 0.0 else f"up to {ms_text(delay_s)}"


def _matrix(columns: Sequence[Sequence[float]]) -> str:
    """A 2 x 2 block as text: one number if both axes have the same gain and are uncoupled, else all four."""
    if not columns:
        return UNKNOWN
    (a, c), (b, d) = columns
    return f"{a:+.4f}" if a == d and b == c == 0.0 else f"[{a:+.4f} {b:+.4f}; {c:+.4f} {d:+.4f}]"


_TRADE_OFF_COLUMNS: dict[str, Callable[[TradeOffPoint], str]] = {
    "delay margin, ms": lambda point: ms_text(point.delay_margin_s, unit=""),
    "largest alpha": lambda point: f"{point.alpha:.3f}",
}
_BLOCK_COLUMNS: dict[str, Callable[[GainBlock], str]] = {
    "vehicle": lambda block: str(block.vehicle),
    "uses": lambda block: str(block.of),
    "spacing error, 1/s²": lambda block: _matrix(list(zip(*block.gain, strict=True))[:-2]),
    "velocity error, 1/s": lambda block: _matrix(list(zip(*block.gain, strict=True))[-2:]),
}
"""The gain matrix block by block: the vehicle, whose errors it uses, and the gains."""
_VEHICLE_COLUMNS: dict[str, Callable[[VehicleSummary], str]] = {
    "vehicle": lambda own: str(own.system_id),
    "error, m\nlargest": lambda own: number_text(own.spacing_error_max_m, ".2f"),
    "\nfinal": lambda own: number_text(own.spacing_error_final_m, ".2f"),
    "RTT p50\nms": lambda own: ms_text(own.rtt_s.p50, unit=""),
    "loop p50\nms": lambda own: ms_text(own.loop_delay_s.p50, unit=""),
    "p99\nms": lambda own: ms_text(own.loop_delay_s.p99, unit=""),
    "headroom\nms": lambda own: ms_text(own.headroom_min_s, unit=""),
    "lost": lambda own: number_text(own.lost, "d"),
    "late": lambda own: number_text(own.late, "d"),
}


def print_summary(summary: Summary, folder: Path) -> None:
    """Print the verdict with its figures, and the location of the files."""
    console = plain_console()
    print_flight(summary, console)
    console.print(f"files    {folder}: {', '.join(summary.files)}")
    looks = [f"gcs view {folder}"] if RECORDING_FILE in summary.files else []
    looks += [f"{folder / file} in a browser" for file in summary.files if file.endswith(".html")]
    if looks:
        console.print(f"look     {', or '.join(looks)}", markup=False)


def flight_lines(summary: Summary) -> dict[str, str]:
    """The lines about a flight as a whole, by heading; the line `verdict` gives only its reason."""
    flown = "" if summary.fleet == STARTED else f"; vehicles {summary.fleet}"
    lines = {"verdict": f"{_reason(summary)}{flown}", "delay": delay_text(summary)}
    if summary.verdict == "unstable" and (summary.headroom_end or 0.0) >= 0.0:
        lines["delay"] += "; set-points that were lost do not show in it"
    if (alpha := summary.at_loop_delay.alpha) is not None:
        lines["alpha"] = figures_text(summary.at_loop_delay)
        if summary.verdict == "unstable":  # the model's growth of errors is not what was flown
            at = ms_text(summary.at_loop_delay.loop_delay_s)
            lines["alpha"] = f"{alpha:.4f} by the model of small errors at {at} of loop delay, the largest median"
    if modes := _modes_text(summary):
        lines["modes"] = modes
    if summary.code:
        lines["code"] = _code_text(summary.code)
    if (law := summary.law) is not None:
        slow = "" if law.over_budget is None else f", {law.over_budget} over {1e3 * law.budget_s:g} ms"
        lines["law"] = f"{law.calls} calls, {law.unusable} without a usable command{slow}"
    if summary.spread is not None and summary.spread.vehicles:
        lines["spread"] = _spread_text(summary.spread)
    if (control := summary.control) is not None:
        settled_s = summary.settling_time_s
        lines["control"] = (
            f"{control.ticks} ticks at {control.rate_hz:g} Hz, {control.deadline_misses} deadline misses; "
            f"{'not settled' if settled_s is None else f'settled after {settled_s:.1f} s'}"
        )
    if summary.not_logged:
        lines["not written"] = "; ".join(summary.not_logged)
    if summary.not_confirmed:
        lines["not confirmed"] = summary.not_confirmed
    return lines


def print_flight(summary: Summary, console: Console) -> None:
    style = {"stable": "bold green", "unstable": "bold red"}.get(summary.verdict, "bold yellow")
    lines = flight_lines(summary)
    console.print(Text.assemble("verdict  ", (summary.verdict, style), f": {lines['verdict']}"))
    if summary.not_confirmed:
        console.print(f"end      not confirmed: {summary.not_confirmed}")
    for text in summary.not_logged:
        console.print(f"log      not written: {text}")
    for name in ("delay", "alpha", "modes"):
        if name in lines:
            console.print(f"{name:<9}{lines[name]}")
    console.print(response_text(summary.response), end="")
    for name in ("spread", "control", "law", "code"):
        if name in lines:
            console.print(f"{name:<9}{lines[name]}")
    for who, counts in (("station", summary.refused), ("vehicles", summary.refused_by_vehicles)):
        if counts:
            console.print(f"refused  by the {who}: {in_words(counts)}")
    if summary.mirror:
        console.print(f"mirror   {in_words(summary.mirror)}")
    console.print(table_of(summary.vehicles, _VEHICLE_COLUMNS, dense=True))


def _modes_text(summary: Summary) -> str:
    """Which vehicles were in FAILSAFE, LOST or CRITICAL, and for how long; empty if none."""
    end_s = summary.duration_s or 0.0
    until_s = {vehicle.system_id: end_s for vehicle in summary.vehicles}
    in_mode_s = {mode: dict.fromkeys(until_s, 0.0) for mode in (Mode.FAILSAFE, Mode.LOST, Mode.CRITICAL)}
    for change in reversed(summary.mode_changes):
        if change.system_id is not None and change.time_s < end_s:
            for_s, until_s[change.system_id] = until_s[change.system_id] - change.time_s, change.time_s
            mode = Mode[change.text.rpartition(" ")[2]]
            if mode in in_mode_s:
                in_mode_s[mode][change.system_id] += for_s
    found = {mode: {own: s for own, s in of.items() if s > 0.0} for mode, of in in_mode_s.items()}
    return ", ".join(
        f"{vehicles_text([*of])} {mode.name} for {'up to ' * (len(of) > 1)}{max(of.values()):.2f} s"
        for mode, of in found.items()
        if of
    )


def _spread_text(spread: FlownSpread) -> str:
    """The rms of the follower with the largest predicted spread, and the deviation of all from their predictions."""
    most = max(spread.vehicles, key=lambda own: own.predicted_rms_m or 0.0)
    apart = [(own.reported_rms_m or 0.0) / (own.predicted_rms_m or 1.0) - 1.0 for own in spread.vehicles]
    of_all = "" if len(apart) == 1 else f", all vehicles {min(apart):+.1%} to {max(apart):+.1%}"
    return (
        f"vehicle {most.system_id}: {number_text(most.reported_rms_m, '.3f')} m rms of the reported spacing error from "
        f"{number_text(spread.from_s, '.1f')} s on, {number_text(most.predicted_rms_m, '.3f')} m predicted{of_all}"
    )


def _reason(summary: Summary) -> str:
    """How the flight ended and, if it was completed, why it counts as unstable or unknown."""
    if summary.verdict == "unknown":
        missing = any(text.startswith(TICKS_FILE) for text in summary.not_logged)
        why = "part of the tick log is missing" if missing else "a loop delay was unknown at the end"
        return f"{summary.reason}, but {why}"
    final_m, most_m = summary.spacing_error_final_m, summary.spacing_error_max_m
    completed = summary.reason.startswith("completed")
    if summary.verdict != "unstable" or not completed or final_m is None or most_m is None:
        return summary.reason
    if summary.settling_time_s is not None:
        return f"errors are small after {summary.duration_s:.1f} s, but the loop delay is past the margin"
    last = {change.system_id: change.text for change in summary.mode_changes}
    all_released = all(last.get(own.system_id, "").endswith(Mode.FAILSAFE.name) for own in summary.vehicles)
    then = ", then all vehicles were released to their failsafe" if all_released else ""
    errors = f"final spacing error {final_m:.2f} m, largest {most_m:.2f} m"
    return f"not settled in {summary.duration_s:.1f} s{then}; {errors}"


def delay_text(summary: Summary) -> str:
    delay, margin_s = summary.loop_delay_s, summary.delay_margin_s
    margin = "no limit" if margin_s is None else f"margin {ms_text(margin_s)}"
    if summary.margin_unknown:
        margin = f"margin unknown: {summary.margin_unknown}"
    ranges = [vehicle.delay_margin_s for vehicle in summary.vehicles]
    least_s = min((own.min or inf for own in ranges), default=inf)
    most_s = max((own.max or 0.0 for own in ranges), default=0.0)
    if margin_s is not None and all(own.min == own.max for own in ranges) and least_s < most_s:
        margin = f"margin {ms_text(least_s, unit='')} to {ms_text(most_s)} by vehicle"
    elif margin_s is not None and most_s > margin_s:
        way = "slower gains" if summary.prediction == "off" else "prediction"
        margin += f", up to {ms_text(most_s)} with {way}"
    bound_s, whose = summary.loop_delay_bound_s, ""
    known = [vehicle for vehicle in summary.vehicles if vehicle.headroom_min is not None]
    if known:
        closest = min(known, key=lambda vehicle: vehicle.headroom_min or 0.0)
        left = "" if closest.headroom_min_s is None else f": {ms_text(closest.headroom_min_s)}"
        whose = f" (vehicle {closest.system_id}{left})"
    over = " over all vehicles" if len(summary.vehicles) > 1 else ""
    error = "" if bound_s is None else f" (clocks: ± {ms_text(bound_s)})"
    return (
        f"loop {ms_text(delay.p50)} p50, {ms_text(delay.p99)} p99, {ms_text(delay.max)} max{over}{error}; "
        f"{margin}; least headroom {number_text(summary.headroom_min, '.0%')}{whose}"
    )


def response_text(response: ResponsePart | None) -> str:
    """A line about the vehicles' response to set-points; empty if they respond at once."""
    if response is None:
        return ""
    if not response.vehicles:
        text = "this margin assumes vehicles that respond at once; theirs is computed before the formation flight"
        return f"response {response.source}: {text}\n"
    lags, gains = (
        sorted(texts)
        for texts in zip(*((f"{v.lag_s:.3f}", f"{v.velocity_gain_1_s:.2f}") for v in response.vehicles), strict=True)
    )
    models = sorted({vehicle.model for vehicle in response.vehicles})
    late_ms = sorted(round(1e3 * vehicle.dead_time_s) for vehicle in response.vehicles)
    dead = f", dead time {' to '.join(dict.fromkeys(map(str, (late_ms[0], late_ms[-1]))))} ms" if late_ms[-1] else ""
    peak = response.string_peak
    grows = "" if peak is None else f"; with it spacing errors {growth_text(peak)} from vehicle to vehicle"
    lag, gain = (" to ".join(dict.fromkeys((each[0], each[-1]))) for each in (lags, gains))
    return (
        f"response {response.source} ({', '.join(models)}): lag {lag} s{dead}, velocity gain {gain} 1/s; included in "
        f"the margin, which would be {ms_text(response.delay_margin_at_once_s)} without it{grows}\n"
    )


def _code_text(code: tuple[CodeRecord, ...]) -> str:
    return ", ".join(f"{each.file}, sha256 {each.sha256[:_HASH]}" for each in code)
