"""Read a scenario file strictly, and write one.

Every fault is a ScenarioError: one line with file, key, what was read and what was wanted.
"""

import hashlib
import itertools
import math
import tomllib
from collections.abc import Iterator, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ValidationError
from pydantic_core import to_json

from scenarios.errors import InWords, ScenarioError, UnreadableError, did_you_mean
from scenarios.keys.autopilot import Sitl
from scenarios.keys.link import Link, Links
from scenarios.keys.part import Fault
from scenarios.link_files import each_link, load_profile, toml_text, with_traces
from scenarios.manoeuvres import contradictions as manoeuvre_contradictions
from scenarios.own_code import as_flown, own_code_faults, with_code
from scenarios.places import place_of, wanted_of
from scenarios.requirements import contradictions as requirement_contradictions
from scenarios.schema import Scenario
from scenarios.shipped import names

_A_VEHICLE = "the system_id of a vehicle of this scenario"


def load(path: Path) -> Scenario:
    """The scenario in a TOML file, fully checked.

    Raises ScenarioError if the file cannot be read, a key is unknown, missing or of a wrong type, or keys contradict
    each other.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        wanted = "a scenario file or the name of one (see gcs scenarios)"
        raise UnreadableError(path, "no such file", wanted + did_you_mean(path.stem, names())) from None
    except IsADirectoryError:
        raise UnreadableError(path, "a folder") from None
    except OSError as error:
        raise UnreadableError(path, f"nothing: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UnreadableError(path, "bytes that are not UTF-8 text") from None
    if not text.strip():
        raise UnreadableError(path, "an empty file")
    return parse(text, path)


def parse(text: str, file: Path) -> Scenario:
    """The scenario in a TOML text; `file` is named in errors."""
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise ScenarioError(file, "file", InWords("lists nested too deeply"), "valid TOML") from None
    except ValueError as error:  # a TOMLDecodeError, or a number of thousands of digits
        raise ScenarioError(file, "file", InWords(error), "valid TOML") from None
    try:
        # Strict validation accepts lists as tuples only from JSON text, in which a TOML date is a string.
        scenario = Scenario.model_validate_json(to_json(data))
        if scenario.code:
            wanted = "no such key: files of code are named by other keys"
            raise ScenarioError(file, "code", InWords("tables"), wanted)
        scenario = checked(scenario, file)
        if scenario.links.profile is not None:
            scenario = with_profile(scenario, scenario.links.profile, file)
        return with_code(with_traces(scenario, file), file)
    except ValidationError as errors:
        key, read, wanted = _first_error(errors, data)
    except ScenarioError as error:
        key, read, wanted = error.place, error.read, error.wanted
    raise ScenarioError(file, place_of(key, text, data), read, wanted)


def with_profile(scenario: Scenario, name: str, file: Path, key: str = "links.profile") -> Scenario:
    """The scenario with the links of a profile for all vehicles; `file` and `key` are named in errors."""
    profile = load_profile(name, file, key)
    links = Links(up=profile.up, down=profile.down, channels=profile.channels, times_from=scenario.links.times_from)
    changed = scenario.model_copy(update={"links": links})
    for place, read, wanted in _links_contradictions(changed):
        raise ScenarioError(file, key, InWords(f"{name!r} with {place} {read!r}"), wanted)
    return changed


def with_loop(scenario: Scenario, loop: Literal["ground", "onboard"], file: Path) -> Scenario:
    """The scenario with its loop closed on the ground or on board; `file` is named in errors.

    Raises ScenarioError if the scenario cannot be flown with this loop.
    """
    return checked(scenario.with_keys(control={"loop": loop}), file)


def checked(scenario: Scenario, file: Path) -> Scenario:
    """The same scenario; raises ScenarioError, which names the file, if its keys contradict each other."""
    for key, read, wanted in _contradictions(scenario):
        raise ScenarioError(file, key, read, wanted)
    return scenario


def with_line(fault: str, file: Path) -> str:
    """A fault "KEY: read …" of the scenario in a file that has been read, with the line of the key in front of it."""
    key, read, rest = fault.partition(": read ")
    text = file.read_text(encoding="utf-8")
    return f"{place_of(key, text, tomllib.loads(text))}{read}{rest}"


def dump(scenario: Scenario) -> str:
    """The scenario as TOML text that `parse` reads back to an equal object.

    The text only names the user's own code: `scenarios.own_code.write_code` writes it.
    """
    return toml_text(as_flown(scenario).model_dump(mode="json", exclude_none=True, exclude={"code"}))


def fingerprint(scenario: Scenario) -> str:
    """Sixteen hexadecimal digits that identify a scenario with all of its keys."""
    flown = as_flown(scenario).model_dump_json(exclude_none=True, exclude=None if scenario.code else {"code"})
    return hashlib.sha256(flown.encode()).hexdigest()[:16]


def _first_error(errors: ValidationError, data: dict[str, Any]) -> tuple[str, object, str]:
    """The first of pydantic's errors: key, what was read, what was wanted."""
    # a misspelt key explains the missing one
    first = min(errors.errors(), key=lambda error: error["type"] != "extra_forbidden")
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    if first["type"] == "extra_forbidden":
        known = sorted(_model_at(first["loc"][:-1]).model_fields)
        near = did_you_mean(str(first["loc"][-1]), known)
        return key, InWords("an unknown key"), f"a known one{near}" if near else f"one of {', '.join(known)}"
    if first["type"] == "missing" and isinstance(first["loc"][-1], int):
        part = first["loc"][:-1]
        count = 1 + max(int(own["loc"][-1]) for own in errors.errors() if own["loc"][:-1] == part)
        read = _value_at(data, part)
        return key.rpartition("[")[0], read, f"a list of {count}, not {len(read)}"
    if first["type"] == "missing":
        return key, None, "a value for this key"
    return key, _value_at(data, first["loc"]), wanted_of(first)


def _model_at(location: tuple[int | str, ...]) -> type[BaseModel]:
    """The schema's class at a place in the file."""
    model: type[BaseModel] = Scenario
    for part in location:
        if isinstance(part, str):
            model = next(_models_in(model.model_fields[part].annotation))
    return model


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in getattr(annotation, "__args__", ()):
        yield from _models_in(argument)


def _value_at(data: Any, location: tuple[int | str, ...]) -> Any:
    for part in location:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            return data
    return data


def _contradictions(scenario: Scenario) -> Iterator[Fault]:
    """Faults that no single key shows. Only the first counts: a check may rely on those before it."""
    yield from _formation_contradictions(scenario)
    yield from manoeuvre_contradictions(scenario)
    yield from _velocity_contradictions(scenario)
    yield from _links_contradictions(scenario)
    yield from own_code_faults(scenario)
    yield from _control_contradictions(scenario)
    yield from requirement_contradictions(scenario)
    yield from _block_contradictions(scenario)
    yield from _hearing_contradictions(scenario)
    yield from _monitor_contradictions(scenario)
    yield from _onboard_contradictions(scenario)
    yield from _autopilot_contradictions(scenario)
    if scenario.autopilot.sitl != Sitl() and scenario.simulated_autopilot is None:
        yield "autopilot.sitl", scenario.autopilot.sitl.model_dump(), "no such key without dynamics autopilot"
    yield from _sector_contradictions(scenario)
    limits = scenario.limits
    if limits.speed_max_m_s is not None and limits.speed_max_m_s <= limits.speed_min_m_s:
        yield "limits.speed_max_m_s", limits.speed_max_m_s, f"more than speed_min_m_s = {limits.speed_min_m_s:g}"


def _control_contradictions(scenario: Scenario) -> Iterator[Fault]:
    control = scenario.control
    requirements = ("alpha", "delay_margin_s", "decay_rate_1_s")
    required, wanted = any(getattr(control, name) is not None for name in requirements), ", ".join(requirements)
    if control.gains is not None and required:
        yield "control.gains", control.gains.model_dump(), f"either gains or a requirement ({wanted})"
    if control.blocks and (required or control.gains is not None):
        read = InWords(f"{len(control.blocks)} blocks")
        yield "control.blocks", read, f"either blocks, or gains, or a requirement ({wanted})"
    if scenario.dynamics == "autopilot" and (control.method != "inclusion" or control.blocks):
        wanted = "inclusion without blocks, with dynamics autopilot: margins with a lag are computed only for its gains"
        yield "control.method", control.method, wanted
    if control.gains is not None and control.method != "inclusion":
        yield "control.method", control.method, "inclusion, with gains given; a graph's gains are given as blocks"
    searched = control.gains is None and (control.criteria is not None or control.for_link != "off")
    if control.feed_forward and (
        control.method != "inclusion" or control.blocks or control.loop == "onboard" or searched
    ):
        wanted = "0, unless method is inclusion without blocks, criteria and for_link, and loop is ground"
        yield "control.feed_forward", control.feed_forward, wanted
    if control.execute_at and scenario.dynamics == "autopilot":
        yield "control.execute_at", control.execute_at, "false, with dynamics autopilot: no autopilot holds set-points"
    if control.prediction != "off" and scenario.dynamics != "double_integrator" and scenario.response is None:
        wanted = f"off, with dynamics {scenario.dynamics} and no [response]: a response must be known to be predicted"
        yield "control.prediction", control.prediction, wanted


def _hearing_contradictions(scenario: Scenario) -> Iterator[Fault]:
    control, known = scenario.control, {vehicle.system_id for vehicle in scenario.vehicles}
    for k, vehicle in enumerate(scenario.vehicles):
        for other in vehicle.hears:
            if other not in known - {vehicle.system_id, vehicle.follows}:
                yield f"vehicles[{k}].hears", other, f"{_A_VEHICLE}, but not itself and not the vehicle it follows"
        if vehicle.hears and (control.method == "inclusion" or control.blocks):
            wanted = "no hears, unless control.method is graph-lqr or graph-dk without blocks"
            yield f"vehicles[{k}].hears", list(vehicle.hears), wanted


def _block_contradictions(scenario: Scenario) -> Iterator[Fault]:
    columns = {vehicle.system_id: 2 if vehicle.follows is None else 4 for vehicle in scenario.vehicles}
    seen: set[tuple[int, int]] = set()
    for k, block in enumerate(scenario.control.blocks):
        for name, system_id in (("vehicle", block.vehicle), ("of", block.of)):
            if system_id not in columns:
                yield f"control.blocks[{k}].{name}", system_id, _A_VEHICLE
        count = columns[block.of]
        if any(len(row) != count for row in block.gain):
            wanted = f"two rows of {count} numbers, as vehicle {block.of} {'leads' if count == 2 else 'follows'}"
            yield f"control.blocks[{k}].gain", [list(row) for row in block.gain], wanted
        if (block.vehicle, block.of) in seen:
            yield f"control.blocks[{k}]", (block.vehicle, block.of), "each pair of vehicles once"
        seen.add((block.vehicle, block.of))


def _monitor_contradictions(scenario: Scenario) -> Iterator[Fault]:
    monitor = scenario.monitor
    if monitor.critical_headroom >= monitor.caution_headroom:
        wanted = f"less than caution_headroom = {monitor.caution_headroom:g}"
        yield "monitor.critical_headroom", monitor.critical_headroom, wanted
    scales = monitor.time_scales
    if scales[0] != 1 or any(slow <= fast for fast, slow in itertools.pairwise(scales)):
        yield "monitor.time_scales", list(scales), "1 first, then increasing factors"


def _onboard_contradictions(scenario: Scenario) -> Iterator[Fault]:
    if scenario.control.loop != "onboard":
        return
    own, control_hz = scenario.onboard, scenario.rates.control_hz
    if scenario.dynamics == "autopilot":
        wanted = "ground, with dynamics autopilot: no supported autopilot can close this loop on board"
        yield "control.loop", scenario.control.loop, wanted
    if own.sensor_hz % control_hz:
        yield "onboard.sensor_hz", own.sensor_hz, f"a whole multiple of rates.control_hz = {control_hz:g}"
    if own.rate_hz % own.sensor_hz:
        yield "onboard.rate_hz", own.rate_hz, f"a whole multiple of onboard.sensor_hz = {own.sensor_hz:g}"


def _formation_contradictions(scenario: Scenario) -> Iterator[Fault]:
    vehicles = scenario.vehicles
    system_ids = [v.system_id for v in vehicles]
    leaders = [v.system_id for v in vehicles if v.follows is None]
    yield from _repeated("vehicles", "system_id", system_ids, "a different number for each vehicle")
    for k, vehicle in enumerate(vehicles):
        if vehicle.follows is not None and vehicle.follows not in system_ids:
            yield f"vehicles[{k}].follows", vehicle.follows, _A_VEHICLE
        if (vehicle.follows is None) != (vehicle.offset_ne_m is None):
            wanted = "both follows and offset_ne_m, or neither for the leader"
            yield f"vehicles[{k}].offset_ne_m", vehicle.offset_ne_m, wanted
        if vehicle.offset_ne_m == (0.0, 0.0):
            yield f"vehicles[{k}].offset_ne_m", vehicle.offset_ne_m, "an offset other than zero"
    try:
        TopologicalSorter({v.system_id: [] if v.follows is None else [v.follows] for v in vehicles}).prepare()
    except CycleError as error:
        cycle: list[int] = error.args[1][::-1]
        wanted = "a tree: every vehicle follows the leader, directly or through others"
        read = InWords(f"a cycle: {' follows '.join(map(str, cycle))}")
        yield f"vehicles[{system_ids.index(cycle[0])}].follows", read, wanted
    if len(leaders) != 1:
        read = InWords(f"vehicles without it: {leaders}")
        yield f"vehicles[{system_ids.index(leaders[-1])}].follows", read, "exactly one vehicle without it, the leader"


def _autopilot_contradictions(scenario: Scenario) -> Iterator[Fault]:
    times_s = [jump.at_s for jump in scenario.autopilot.clock_jumps]
    if times_s != sorted(times_s):
        yield "autopilot.clock_jumps", times_s, "times that do not decrease"
    for key, part in (("autopilot", scenario.autopilot), ("response", scenario.response)):
        if part is not None and part.dead_time_s and part.natural_frequency_rad_s is not None:
            wanted = "no such key with natural_frequency_rad_s: one model at a time"
            yield f"{key}.dead_time_s", part.dead_time_s, wanted
    if scenario.dynamics == "autopilot":
        yield from _take_off_contradictions(scenario)
        return
    for k, vehicle in enumerate(scenario.vehicles):
        if vehicle.flavour is not None:
            yield f"vehicles[{k}].flavour", vehicle.flavour, "no such key without dynamics autopilot"
    if scenario.response is not None and scenario.dynamics == "double_integrator":
        wanted = "no such key with dynamics double_integrator, which respond at once"
        yield "response", scenario.response.model_dump(), wanted


def _take_off_contradictions(scenario: Scenario) -> Iterator[Fault]:
    climb_m_s, patience_s = scenario.autopilot.climb_max_m_s, scenario.safety.ready_patience_s
    reached = f"autopilot.climb_max_m_s = {climb_m_s:g} reaches in safety.ready_patience_s = {patience_s:g}"
    for k, vehicle in enumerate(scenario.vehicles):
        key, altitude_m = f"vehicles[{k}].altitude_m", vehicle.altitude_m
        if altitude_m is None:
            key, altitude_m = "altitude_m", scenario.altitude_m if "altitude_m" in scenario.model_fields_set else None
        if not altitude_m:
            read = InWords("no such key") if altitude_m is None else altitude_m
            yield key, read, "an altitude above 0 to take off to, with dynamics autopilot"
        elif altitude_m > climb_m_s * patience_s:
            yield key, altitude_m, f"at most {climb_m_s * patience_s:g}, which {reached}"


def _sector_contradictions(scenario: Scenario) -> Iterator[Fault]:
    sector = None if scenario.disturbance is None else scenario.disturbance.sector
    if sector is None:
        return
    key, count = "disturbance.sector", 2 * len(scenario.vehicles) - 1
    if scenario.dynamics != "double_integrator":
        yield key, InWords(f"dynamics {scenario.dynamics}"), "no such key, unless dynamics is double_integrator"
    if len(scenario.nominal_velocity) != 1 or scenario.manoeuvres:
        wanted = "no such key, unless one nominal velocity and one shape are flown"
        yield key, InWords("velocities or offsets that change"), wanted
    square = len(sector.direction) == count and all(len(row) == count for row in sector.direction)
    if not square or not any(any(row) for row in sector.direction):
        read = f"{len(sector.direction)} rows of {sorted({len(row) for row in sector.direction})} numbers"
        yield f"{key}.direction", InWords(read), f"{count} rows of {count} numbers, not all zero"
    for name, found in (("all_pass_in", sector.all_pass_in), ("all_pass_out", sector.all_pass_out)):
        if len(found) not in (0, count):
            yield f"{key}.{name}", InWords(f"{len(found)} numbers"), f"{count} numbers, or none"


def _velocity_contradictions(scenario: Scenario) -> Iterator[Fault]:
    on_ground = scenario.starts_on_ground
    lowest = 0.0 if on_ground else scenario.limits.speed_min_m_s  # multicopters can stand
    highest = scenario.limits.speed_max_m_s or math.inf
    wanted_speed = f"a speed within the limits, {lowest:g} to {highest:g} m/s"
    before_s = -math.inf
    for k, entry in enumerate(scenario.nominal_velocity):
        if entry.from_s <= before_s or (k == 0 and entry.from_s != 0):
            yield f"nominal_velocity[{k}].from_s", entry.from_s, "0 for the first entry, then increasing times"
        if not lowest <= math.hypot(*entry.velocity_ne_m_s) <= highest:
            yield f"nominal_velocity[{k}].velocity_ne_m_s", entry.velocity_ne_m_s, wanted_speed
        before_s = entry.from_s
    for k, vehicle in enumerate(scenario.vehicles):
        speed_m_s = math.hypot(*vehicle.velocity_ne_m_s)
        if not (speed_m_s == 0 if on_ground else lowest <= speed_m_s <= highest):
            wanted = "[0, 0] with dynamics autopilot" if on_ground else wanted_speed
            yield f"vehicles[{k}].velocity_ne_m_s", vehicle.velocity_ne_m_s, wanted


def _links_contradictions(scenario: Scenario) -> Iterator[Fault]:
    links = scenario.links
    if links.profile is not None and (given := {"up", "down", "vehicles", "channels"} & links.model_fields_set):
        yield "links.profile", links.profile, f"either a profile, or {', '.join(sorted(given))}"
    own = [link.system_id for link in links.vehicles]
    for k in (k for k, system_id in enumerate(own) if system_id not in {v.system_id for v in scenario.vehicles}):
        yield f"links.vehicles[{k}].system_id", own[k], _A_VEHICLE
    yield from _repeated("links.vehicles", "system_id", own, "one entry per vehicle")
    names = [channel.name for channel in links.channels]
    yield from _repeated("links.channels", "name", names, "a different name for each channel")
    for k, channel in enumerate(links.channels):
        if (channel.queue_bytes is None) == (channel.queue_datagrams is None):
            read = "neither" if channel.queue_bytes is None else "both"
            yield f"links.channels[{k}]", InWords(read), "either queue_bytes or queue_datagrams"
    for key, link in each_link(links):
        if link.channel is not None and link.channel not in names:
            yield f"{key}.channel", link.channel, f"the name of one of links.channels: {', '.join(names) or 'none'}"
        yield from _link_contradictions(key, link)


def _repeated(part: str, name: str, values: Sequence[object], wanted: str) -> Iterator[Fault]:
    """Faults for the values of a key that repeat those of earlier entries of a list."""
    for k, value in enumerate(values):
        if value in values[:k]:
            yield f"{part}[{k}].{name}", value, wanted


def _link_contradictions(key: str, link: Link) -> Iterator[Fault]:
    times_s = [point.at_s for point in link.delay_points]
    if times_s and link.delay_s:
        yield f"{key}.delay_s", link.delay_s, "either delay_s or delay_points"
    for k, time_s in enumerate(times_s):
        if k and time_s < times_s[k - 1]:
            yield f"{key}.delay_points[{k}].at_s", time_s, "times that do not decrease"
        if times_s[max(k - 2, 0) : k] == [time_s, time_s]:
            yield f"{key}.delay_points[{k}].at_s", time_s, "at most two points at the same time, which make a step"
    if link.loss_bursts is not None and link.loss_probability:
        yield f"{key}.loss_probability", link.loss_probability, "either loss_probability or loss_bursts"
    before_s = 0.0
    for k, outage in enumerate(link.outages):
        if outage.until_s <= outage.from_s:
            yield f"{key}.outages[{k}].until_s", outage.until_s, f"more than from_s = {outage.from_s:g}"
        if outage.from_s < before_s:
            wanted = f"at least until_s = {before_s:g} of the outage before"
            yield f"{key}.outages[{k}].from_s", outage.from_s, wanted
        before_s = outage.until_s
    if link.jitter is not None:
        yield from link.jitter.contradictions(f"{key}.jitter")
