"""Options that several commands share, and the one-line error for each bad value."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from gcs.errors import InputError, beyond, usable

if TYPE_CHECKING:
    from gcs.drive.guard import Guard
    from gcs.drive.mirror import Mirror
    from gcs.drive.udp import StationSocket
    from gcs.plan.design import Design
    from gcs.plan.flight_plan import FlightPlan
    from scenarios.schema import Scenario


Result = TypeVar("Result")

LoopPlace = Literal["ground", "onboard"]
"""Where the loop is closed, as in `control.loop` of a scenario."""


def _shipped(incomplete: str) -> list[str]:
    """The shipped scenarios that shell completion offers for the beginning of a name, in addition to files."""
    from scenarios.shipped import names

    return [name for name in names() if name.startswith(incomplete)]


ScenarioFile = Annotated[
    Path,
    typer.Argument(
        metavar="SCENARIO",
        help="scenario file, or the name of a shipped scenario (see gcs scenarios)",
        autocompletion=_shipped,
    ),
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="run folder")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON and nothing else")]
OutFolder = Annotated[Path | None, typer.Option(metavar="DIR", help="new or empty folder; default runs/NAME-TIME")]
AllowUnstable = Annotated[
    bool, typer.Option("--allow-unstable", help="accept gains whose loop is unstable without any delay")
]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="run the Python code that the scenario names: it can do whatever you can")
]
LoopOption = Annotated[
    LoopPlace | None,
    typer.Option("--loop", help="who closes the loop on a vehicle's own errors; default as in the scenario"),
]
LinksOption = Annotated[
    str | None,
    typer.Option(
        "--links",
        metavar="NAME|FILE",
        help="replace the scenario's links with this profile (see gcs scenarios --links)",
    ),
]
LinkDelayOption = Annotated[
    float | None,
    typer.Option(
        "--link-delay",
        metavar="SECONDS",
        min=0,
        max=60,
        help="constant delay of every link, each way; --delay of gcs stress is up + down",
    ),
]
KeyFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="sign with this key, and accept only frames signed with it (see gcs key)"),
]


def print_json(result: Any) -> None:
    """Print a record, or an object of records, as JSON."""
    from gcs.published import json_text

    def fields(record: Any) -> Any:
        return record.to_dict() if hasattr(record, "to_dict") else asdict(record)

    typer.echo(json_text(result if isinstance(result, dict) else fields(result), default=fields))


def answer(result: Result, show: Callable[[Result], None], *, as_json: bool) -> None:
    """Print a result: as JSON, or with `show`."""
    if as_json:
        print_json(result)
    else:
        show(result)


def load_scenario(
    file: Path,
    loop: LoopPlace | None = None,
    left_out: Sequence[int] | None = None,
    *,
    links: str | None = None,
    link_delay_s: float | None = None,
    allow_code: bool | str = False,
) -> "Scenario":
    """The scenario in a file, or the shipped one of that name; `loop` overrides where its loop is closed.

    `left_out` are system ids of vehicles to leave out, `links` names a profile that replaces its links, and
    `link_delay_s` replaces their delay, each way. A scenario that names code is refused unless `allow_code` is True;
    if it is a text, the refusal says that this is wanted instead. Raises scenarios.errors.ScenarioError if the file
    cannot be used, or not with this loop, without these vehicles, or with these links.
    """
    from scenarios.files import load, with_loop, with_profile
    from scenarios.left_out import without
    from scenarios.own_code import refusal
    from scenarios.shipped import located

    scenario = load(located(str(file)))
    explain_compiling()
    if allow_code is not True and (refused := refusal(scenario, file, allow_code or "")):
        raise InputError(refused)
    if links is not None:
        scenario = with_profile(scenario, links, Path("--links"), "")
    if link_delay_s is not None:
        scenario = scenario.with_link_delay(up_s=link_delay_s, down_s=link_delay_s)
    scenario = scenario if loop is None else with_loop(scenario, loop, file)
    return without(scenario, left_out, file) if left_out else scenario


def explain_compiling() -> None:
    """Explain on a terminal why the first flight on a machine, or after an update, starts late."""
    from scenarios.kernel import before_compiling

    text = "compiling the code that runs for every frame: one or two minutes, kept for later flights"
    if sys.stderr.isatty() and not before_compiling:
        before_compiling.append(lambda: print(text, file=sys.stderr))


def refuse(file: Path, *findings: str | None, in_file: bool = True) -> None:
    """Refuse a scenario with the first of these findings that is not None.

    The message names the line in the file, unless an option replaced what is written there (not `in_file`).
    """
    from scenarios.files import with_line
    from scenarios.shipped import located

    for finding in findings:
        if finding is not None:
            raise InputError(f"{file}: {with_line(finding, located(str(file))) if in_file else finding}")


def refuse_or_warn(file: Path, finding: str, *, allow: bool) -> None:
    """Refuse a scenario for a finding, or only warn about it if `allow`."""
    if not allow:
        refuse(file, finding)
    warn(file, finding)


def warn(file: Path, finding: str) -> None:
    print(f"warning: {file}: {finding}", file=sys.stderr)


def flyable(file: Path, design: "Design", plan: "FlightPlan", *, allow_unstable: bool) -> "tuple[Design, FlightPlan]":
    """Design and plan as flown, with their margins over the scenario's own links; warns if these differ.

    An unstable loop is refused, or only warned about if `allow_unstable`; its monitor then only watches.
    """
    from gcs.plan import planner
    from gcs.preflight import faults
    from gcs.views.console import ms_text

    if (unstable := faults.unstable_loop(plan)) is not None:
        refuse_or_warn(file, unstable, allow=allow_unstable)
        return design, faults.without_actions(plan)
    design, flown = planner.over_own_links(design, plan)
    if flown.margins_s != plan.margins_s:
        least_s = min(flown.tolerance_of(row, 0.0).longer_s[0] for row in range(flown.model.vehicles))
        finding = f"the least margin is {ms_text(least_s)}, and {ms_text(plan.delay_margin_s)} if delays were alike"
        warn(file, f"vehicles share a loop, and their loop delays differ: {finding}")
    return design, flown


def out_folder(out: Path, wanted: str = "a new or empty folder", option: str = "--out") -> Path:
    """The new or empty folder that an option names; it is created if it does not exist."""
    with usable(f"{option}: {out}", "a folder that can be written"):
        out.mkdir(parents=True, exist_ok=True)
        used = any(out.iterdir())
    if used:
        raise InputError(f"{option}: {out} is not empty, wanted {wanted}")
    return out


def refuse_out(out: Path, wanted: str = "a new or empty folder") -> None:
    """Refuse an unusable --out before any work is done for it; leaves no new folder behind."""
    new = not out.exists()
    out_folder(out, wanted)
    if new:
        out.rmdir()


def campaign_folder(out: Path | None, flag: str, kind: str) -> Path:
    """The folder in --out that holds a campaign or another `kind` of study, which `flag` needs."""
    if out is None:
        raise InputError(f"{flag}: read no --out, wanted --out with the folder of a {kind}")
    if not out.is_dir():
        raise InputError(f"--out: read {out}, wanted the folder of a {kind}, which {flag} needs")
    return out


def run_folder(out: Path | None, name: str) -> Path:
    """The folder that --out names, or a new one in runs/ with a name and the time."""
    from gcs.drive.fly import new_folder

    return new_folder(name) if out is None else out_folder(out)


def out_file(option: str, file: Path) -> None:
    """Refuse an unwritable file before any work is done for it; creates its folder."""
    with usable(f"{option}: {file}", "a file that can be written"):
        new = not file.exists()
        file.parent.mkdir(parents=True, exist_ok=True)
        file.open("ab").close()
        if new:
            file.unlink()


def address(option: str, text: str) -> tuple[str, int]:
    """Host and port from the HOST:PORT given to an option."""
    host, _, port = text.rpartition(":")
    try:
        known = bool(host.encode("idna")) and port.isdecimal() and len(port) <= 5 and int(port) <= 65535
    except UnicodeError:
        known = False
    if not known:
        raise InputError(f"{option}: read {text!r}, wanted HOST:PORT, such as 127.0.0.1:14550")
    return host, int(port)


def listening(
    option: str,
    text: str,
    guard: "Guard | None" = None,
    networks: Sequence[int] = (0,),
    *,
    together: bool = False,
) -> "StationSocket":
    """Open the socket that listens to the networks at the HOST:PORT given to an option (see `StationSocket`)."""
    from gcs.drive.udp import StationSocket

    host, port = address(option, text)
    every = ", ".join(map(str, networks))
    ports = "a free UDP port" if every == "0" else f"free UDP ports, the one given plus {every}"
    with usable(f"{option}: {text}", f"{ports} of this machine"):
        return StationSocket(host, port, guard, networks, together=together)


def warn_if_open(link: "StationSocket") -> None:
    """Warn if other machines can reach the socket while nothing is signed."""
    host, port = link.address
    if link.guard is None and not ip_address(host).is_loopback:
        text = "other machines can reach it and nothing is signed; gcs key FILE makes a key for --key"
        typer.echo(f"warning: {host}:{port} is open: {text}", err=True)


def opened_guard(key: Path | None, *, role: str) -> "Guard | None":
    """The guard that signs and verifies frames with the key in a file; None if no key was given."""
    if key is None:
        return None
    from gcs.drive.guard import open_guard
    from scenarios.sockets import realtime_offset_ns

    return open_guard(key, epoch_ns=realtime_offset_ns(), role=role)


def mirroring(text: str, link: "StationSocket", *, commands: bool) -> "Mirror":
    """Open the mirror for --mirror HOST:PORT; `link` is the socket on which this station itself listens."""
    from gcs.drive.mirror import Mirror

    host, port = address("--mirror", text)
    if port == 0:
        raise InputError(f"--mirror: read {text}, wanted the port of a ground station")
    if len(link.networks) > 1:
        wanted = "wanted one: another station knows vehicles by their ids in frames"
        raise InputError(f"--mirror: read vehicles in the networks {' '.join(map(str, link.networks))}, {wanted}")
    with usable(f"--mirror: {text}", "the address of a ground station"):
        mirror = Mirror(host, port, commands=commands, signed=None if link.guard is None else link.guard.mirror_link)
    (to_host, to_port), (own_host, own_port) = mirror.address, link.address
    here = to_host == own_host or (ip_address(own_host).is_unspecified and ip_address(to_host).is_loopback)
    if here and to_port == own_port:
        with mirror:
            wanted = "wanted that of another ground station"
            raise InputError(f"--mirror: read {text}, which is this station's own, {wanted}")
    return mirror


def refuse_alone(option: str, value: object, needed: str, *given: object) -> None:
    """Refuse an option given without any of the options that it needs. The value of an option not given is None."""
    if value is not None and all(other is None for other in given):
        raise InputError(f"read {option} without {needed}, wanted it with {needed}")


def unmet_headroom(found: float | None, least: float, of: str = "") -> str:
    """The message for an --assert-headroom that does not hold, or "". `of` says whose headroom was `found`."""
    if found is not None and found >= least:
        return ""
    read = "no headroom" if found is None else beyond(100.0 * found, 100.0 * least, 1) + "%"
    return f"--assert-headroom: read {read}{of}, wanted at least {100.0 * least:g}%"


def say_failed(failure: str) -> None:
    print(f"failed: {failure}", file=sys.stderr)
