"""Scenario files: what is accepted, and that everything else is refused in one line that says why."""

import re
import tomllib
from pathlib import Path

import pytest
import tomlkit
from pydantic import ValidationError

from gains.core.requirement import ALPHA_MIN, DELAY_MARGIN_MAX_S, Requirement
from scenarios.errors import ScenarioError
from scenarios.files import checked, dump, fingerprint, load, parse
from scenarios.link_files import toml_text
from scenarios.schema import Control, Scenario
from scenarios.shipped import columns
from tests.support.paths import SCENARIOS

TRIANGLE = (SCENARIOS / "triangle5.toml").read_text(encoding="utf-8")
FILE = Path("x.toml")


@pytest.mark.parametrize("file", sorted(SCENARIOS.glob("*.toml")), ids=lambda file: file.stem)
def test_every_scenario_in_the_repository_is_valid_and_survives_writing(file: Path) -> None:
    scenario = load(file)
    assert scenario.name == file.stem
    assert parse(dump(scenario), FILE) == scenario


def test_a_fingerprint_identifies_links_seed_and_scenario() -> None:
    given = [load(file) for file in sorted(SCENARIOS.glob("*.toml"))]
    assert all(fingerprint(parse(dump(scenario), Path("again"))) == fingerprint(scenario) for scenario in given)
    first = given[0]
    others = [first.with_link_delay(up_s=0.4, down_s=None), first.model_copy(update={"seed": first.seed + 1})]
    found = {fingerprint(scenario) for scenario in (*given, *others)}
    assert len(found) == len(given) + 2


def test_triangle5_is_the_thesis_formation() -> None:
    scenario = load(SCENARIOS / "triangle5.toml")
    assert scenario.nominal_velocity_at(0.0) == (pytest.approx(300 * 0.3048), 0.0)
    offsets = {v.system_id: (v.follows, v.offset_ne_m) for v in scenario.vehicles}
    spacing = pytest.approx(400 * 0.3048)
    assert offsets[1] == (None, None)
    for right, left in ((2, 4), (3, 5)):
        (ahead_right, right_offset), (ahead_left, left_offset) = offsets[right], offsets[left]
        assert right_offset is not None
        assert left_offset is not None
        assert (-right_offset[0], right_offset[1]) == (spacing, spacing)
        assert left_offset == (right_offset[0], -right_offset[1])
        assert (ahead_right, ahead_left) in {(1, 1), (2, 4)}


def test_leader_first_puts_every_vehicle_after_the_one_it_follows() -> None:
    seen: set[int | None] = {None}
    for vehicle in load(SCENARIOS / "triangle5.toml").leader_first():
        assert vehicle.follows in seen
        seen.add(vehicle.system_id)
    assert seen == {None, 1, 2, 3, 4, 5}


def test_nominal_velocity_is_piecewise_constant() -> None:
    scenario = load(SCENARIOS / "triangle5_turns.toml")
    courses = [scenario.nominal_velocity_at(t) for t in (-1.0, 0.0, 24.99, 25.0, 25.34, 31.65, 49.0, 56.65, 1e6)]
    turning = [(49.802, -76.688)] * 2
    assert courses == [(45.72, -79.189)] * 3 + turning + [(91.44, 0.0)] * 2 + [(45.72, 79.189)] * 2


def test_link_delay_override_reaches_vehicles_with_links_of_their_own() -> None:
    text = TRIANGLE + "\n[[links.vehicles]]\nsystem_id = 3\nup = { delay_s = 0.1 }\n"
    scenario = parse(text, FILE)
    assert [link.delay_s for link in scenario.link_of(3)] == [0.1, 0.02]
    assert [link.delay_s for link in scenario.link_of(2)] == [0.02, 0.02]
    other = scenario.with_link_delay(up_s=0.4, down_s=None)
    assert [link.delay_s for link in other.link_of(3)] == [0.4, 0.02]


SECTOR = "[rates]", "[disturbance.sector]\nnorm_1_s = 1.0\ndirection = {}\n{}\n[rates]"
SQUARE = [[1.0] * 9] * 9
BAD = {
    "gusts without a time": ("[rates]", "[disturbance]\ngusts = { deviation_m_s2 = 1.0 }\n[rates]", "disturb", "value"),
    "sector too small": (SECTOR[0], SECTOR[1].format([[1.0]], ""), "disturbance.sector.direction", "9 rows of 9"),
    "sector of zeros": (SECTOR[0], SECTOR[1].format([[0.0] * 9] * 9, ""), "disturbance.sector.direction", "not all"),
    "too few filters": (SECTOR[0], SECTOR[1].format(SQUARE, "all_pass_in = [0.5]"), "disturbance.sector.all", "9 numb"),
    "filter too slow": (SECTOR[0], SECTOR[1].format(SQUARE, "all_pass_out = [-1]"), "disturbance.sector.all", "than"),
    "unknown key": ("follows = 1", "folows = 1", "vehicle 2: folows", "follows"),
    "unknown section": ("[rates]", "[rate]", "rate", "rates"),
    "wrong unit": ("up = { delay_s = 0.02 }", "up = { delay_ms = 20 }", "links.up.delay_ms", "delay_s"),
    "wrong type": ("seed = 1", 'seed = "one"', "seed", "integer"),
    "number as text": ("control_hz = 50.0", 'control_hz = "50"', "rates.control_hz", "number"),
    "date": ("duration_s = 40.0", "duration_s = 2026-01-01", "duration_s", "number"),
    "missing key": ("seed = 1\n", "", "seed", "a value"),
    "short pair": ("[91.44, 0.0]", "[91.44]", "nominal_velocity[0].velocity_ne_m_s", "a list of 2, not 1"),
    "not a number": ("[91.44, 0.0]", "[nan, 0.0]", "nominal_velocity[0].velocity_ne_m_s[0]", "finite"),
    "infinite": ("duration_s = 40.0", "duration_s = inf", "duration_s", "finite"),
    "beyond single precision": ("altitude_m = 1000.0", "altitude_m = 1e300", "altitude_m", "1000000"),
    "far away": ("[-121.92, 121.92]", "[-1e300, 121.92]", "vehicle 2: offset_ne_m[0]", "-1000000"),
    "faster than anything": ("[91.44, 0.0]", "[1e5, 0.0]", "nominal_velocity[0].velocity_ne_m_s[0]", "10000"),
    "a delay of years": ("up = { delay_s = 0.02 }", "up = { delay_s = 1e9 }", "links.up.delay_s", "1000000"),
    "negative delay": ("up = { delay_s = 0.02 }", "up = { delay_s = -0.02 }", "links.up.delay_s", "at least 0"),
    "zero rate": ("telemetry_hz = 50.0", "telemetry_hz = 0.0", "rates.telemetry_hz", "at least 1"),
    "unknown leader": ("follows = 1", "follows = 9", "vehicle 2: follows", "system_id of a vehicle"),
    "itself": ("follows = 1", "follows = 2", "vehicle 2: follows", "tree"),
    "cycle": ("follows = 1", "follows = 3", "vehicle 2: follows", "tree"),
    "two with one id": ("system_id = 3", "system_id = 2", "vehicle in place 3: system_id", "a different number"),
    "id of a station": ("system_id = 3", "system_id = 255", "vehicle 255: system_id", "at most 250"),
    "two leaders": ("follows = 1\noffset_ne_m = [-121.92, 121.92]\n", "", "vehicle 2: follows", "exactly one"),
    "offset without leader": ("follows = 1\n", "", "vehicle 2: offset_ne_m", "neither"),
    "no distance": ("[-121.92, 121.92]", "[0.0, 0.0]", "vehicle 2: offset_ne_m", "other than zero"),
    "late first velocity": ("from_s = 0.0", "from_s = 1.0", "nominal_velocity[0].from_s", "0 for the first"),
    "too slow to fly": ("[91.44, 0.0]  #", "[0.0, 0.0]  #", "nominal_velocity[0].velocity_ne_m_s", "speed"),
    "unknown method": ('"inclusion"', '"magic"', "control.method", "inclusion"),
    "a delay of minus one": (
        'loop = "ground"',
        "prediction = -1.0",
        "control.prediction",
        "off, measured, or a number",
    ),
    "feed-forward of a design to criteria": (
        'loop = "ground"',
        'loop = "ground"\nfeed_forward = 0.5\ncriteria = { damping_min = 0.5 }',
        "control.feed_forward",
        "0, unless method is inclusion",
    ),
    "alpha of one": ("delay_margin_s = 0.3", "alpha = 1.0", "control.alpha", "less than 1"),
    "gains and requirement": (
        "delay_margin_s = 0.3",
        "delay_margin_s = 0.3\ngains = { K1 = -1.0, K2 = 0.0, K3 = 1.0 }",
        "control.gains",
        "either",
    ),
    "lists without end": ("seed = 1", "seed = " + "[" * 20000, "file", "valid TOML"),
    "thousands of digits": ("seed = 1", "seed = " + "9" * 5000, "file", "valid TOML"),
    "no TOML": ("seed = 1", "seed = = 1", "file", "valid TOML"),
}


@pytest.mark.parametrize(("old", "new", "key", "wanted"), BAD.values(), ids=BAD)
def test_a_bad_scenario_names_file_key_and_what_was_wanted(old: str, new: str, key: str, wanted: str) -> None:
    assert old in TRIANGLE
    with pytest.raises(ScenarioError) as error:
        parse(TRIANGLE.replace(old, new, 1), FILE)
    line = str(error.value)
    place, _, rest = line.partition(": read ")
    assert "\n" not in line
    assert re.sub(r"line \d+: ", "", place).startswith(f"x.toml: {key}")
    assert wanted in rest.partition("wanted ")[2]


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        ("[91.44, 0.0]", "[1.0, 2.0, 3.0]", "read [1.0, 2.0, 3.0], wanted a list of at most 2, not 3"),
        ("seed = 1", "seed = 1.5", "read 1.5, wanted an integer"),
        ("offset_ne_m = [-121.92, 121.92]", "offset_ne_m = 5", "read 5, wanted a list in brackets"),
        ("control_hz = 50.0", "control_hz = 501.0", "read 501.0, wanted a number of at most 500"),
        ('name = "triangle5"', 'name = "a b"', "read 'a b', wanted a name of letters, digits, - and _"),
        ('name = "triangle5"', "name = 5", "read 5, wanted text in quotes"),
        ("up = { delay_s = 0.02 }", "up = 5", "read 5, wanted a table of keys"),
        ("up = { delay_s = 0.02 }", "up = { reordering = 1 }", "read 1, wanted true or false"),
        ("up = { delay_s = 0.02 }", "up = { loss_probability = 2 }", "read 2, wanted a number of at most 1"),
        ("delay_margin_s = 0.3", "delay_margin_s = 0.0", "read 0.0, wanted a number greater than 0"),
    ],
)
def test_errors_say_what_was_wanted_with_the_line(old: str, new: str, wanted: str) -> None:
    changed = TRIANGLE.replace(old, new, 1)
    with pytest.raises(ScenarioError) as error:
        parse(changed, FILE)
    told = str(error.value)
    assert wanted in told
    number = next(k for k, line in enumerate(changed.splitlines(), 1) if new in line)
    assert told.startswith(f"x.toml: line {number}: ")


def test_errors_name_the_system_id_and_the_line() -> None:
    lines = TRIANGLE.splitlines()
    at = [k for k, line in enumerate(lines) if line.startswith("system_id")][4]
    lines.insert(at + 1, "colour = 1")
    with pytest.raises(ScenarioError, match=rf"x\.toml: line {at + 2}: vehicle 5: colour: read an unknown key"):
        parse("\n".join(lines), FILE)


def test_every_error_that_the_schema_can_raise_has_a_text() -> None:
    """All kinds of types in pydantic's core schema of a scenario are covered."""
    kinds = set(re.findall(r"'type': '([a-z-]+)'", repr(Scenario.__pydantic_core_schema__)))
    covered = {"model", "model-fields", "model-field", "default", "nullable", "int", "float", "bool", "str", "tuple"}
    one_fault = {"function-wrap", "function-after", "no-info", "union"}  # a key of two types, and system ids
    assert kinds <= covered | one_fault | {"literal", "definitions", "definition-ref"}


def test_links_of_an_unknown_vehicle_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"line \d+: links of vehicle 9: system_id: read 9"):
        parse(TRIANGLE + "\n[[links.vehicles]]\nsystem_id = 9\n", FILE)


def test_missing_file_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"nowhere\.toml: read no such file, wanted a scenario file or the name of"):
        load(Path("nowhere.toml"))


JITTER = "up = { delay_s = 0.02, jitter = "
WORDS = {
    "no offset": ("offset_ne_m = [-121.92, 121.92]\n", "", "vehicle 2: offset_ne_m: read nothing, wanted both follows"),
    "no seed": ("seed = 1\n", "", "x.toml: seed: read nothing, wanted a value for this key"),
    "half a pair": ("[-121.92, 121.92]", "[-25.0]", "offset_ne_m: read [-25.0], wanted a list of 2, not 1"),
    "no pair": ("[-121.92, 121.92]", "[]", "offset_ne_m: read [], wanted a list of 2, not 0"),
    "a key too many": (
        "up = { delay_s = 0.02",
        JITTER + '{ distribution = "normal", scale_s = 1.0, shape = 2.0 }',
        "links.up.jitter.shape: read 2.0, wanted no such key with distribution normal",
    ),
    "a key too few": (
        "up = { delay_s = 0.02",
        JITTER + '{ distribution = "gamma", shape = 2.0 }',
        "links.up.jitter.scale_s: read nothing, wanted a number, with distribution gamma",
    ),
    "no trace": (
        "up = { delay_s = 0.02",
        JITTER + '{ distribution = "trace" }',
        "links.up.jitter: read neither, wanted either trace_file or trace_s with distribution trace",
    ),
    "a misspelt section": ("[links]", "[link]", "link: read an unknown key, wanted a known one; did you mean links?"),
    "a key like none": ("seed = 1", "zzz = 1", "zzz: read an unknown key, wanted one of altitude_m, at_end"),
}


@pytest.mark.parametrize(("old", "new", "told"), WORDS.values(), ids=WORDS)
def test_errors_say_in_words_what_was_read(old: str, new: str, told: str) -> None:
    assert old in TRIANGLE
    with pytest.raises(ScenarioError) as error:
        parse(TRIANGLE.replace(old, new, 1), FILE)
    assert told in str(error.value)


@pytest.mark.parametrize(("name", "meant"), [("triangel5", "; did you mean triangle5?"), ("nowhere", "scenarios)")])
def test_a_close_name_of_a_shipped_scenario_is_offered(name: str, meant: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load(Path(name))
    assert str(error.value).endswith(meant)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("delay_s = 0.02 }    # tel", "delay_s = -1 }    # tel", 22),
        ("{ system_id = 3,", "{ system_id = 300,", 15),
        ("[-79, 83]", "[-79]", 15),
        ("follows = 1,", "follows = 3,", 14),
        ("[25.0, 0.0] }]", "[25.0] }]", 9),
        ("delay_margin_s = 0.3", "delay_margin_s = 31", 19),
        ("delay_margin_s = 0.3", "alpha = 4e-4", 19),
        ("up = { delay_s = 0.02 }", 'profile = "lte"', 22),
        ("[control]\ndelay_margin_s = 0.3", "control = { delay_margin_s = 300 }", 18),
    ],
)
def test_mistakes_in_a_new_scenario_are_located(old: str, new: str, line: int) -> None:
    text = columns("mine", 1, 3)
    assert old in text
    text = text.replace(old, new, 1)
    if "control = {" in new:  # a key of the whole file stands before its tables
        text = "\n".join([new, *text.replace(new, "").splitlines()])
        line = 1
    with pytest.raises(ScenarioError, match=rf"^x\.toml: line {line}: "):
        parse(text, FILE)


def test_bounds_of_requirements_are_those_of_designs() -> None:
    most_s, least = DELAY_MARGIN_MAX_S, ALPHA_MIN
    assert Control(delay_margin_s=most_s).delay_margin_s == Requirement(delay_margin_s=most_s).delay_margin_s
    assert Control(alpha=least).alpha == Requirement(alpha=least).alpha
    for past in ({"delay_margin_s": 1.001 * most_s}, {"alpha": 0.999 * least}):
        with pytest.raises(ValidationError):
            Control.model_validate(past)


@pytest.mark.parametrize("delay_s", [-0.1, float("nan"), float("inf")])
def test_a_negative_or_non_finite_link_delay_is_refused(delay_s: float) -> None:
    with pytest.raises(ScenarioError, match=r"triangle5: down_s: read .*, wanted a delay in seconds, from 0"):
        load(SCENARIOS / "triangle5.toml").with_link_delay(up_s=0.1, down_s=delay_s)


def test_every_copter_must_have_an_altitude_to_take_off_to() -> None:
    copters = load(SCENARIOS / "copters5.toml")

    def flown_at(altitude_m: float, own_m: float) -> Scenario:
        vehicles = tuple(vehicle.model_copy(update={"altitude_m": own_m}) for vehicle in copters.vehicles)
        return checked(copters.model_copy(update={"altitude_m": altitude_m, "vehicles": vehicles}), FILE)

    assert flown_at(0.0, 20.0).altitude_m == 0.0  # not used: each vehicle has its own
    with pytest.raises(ScenarioError, match=r"vehicles\[0\]\.altitude_m: read 0.0, wanted an altitude above 0"):
        flown_at(20.0, 0.0)


@pytest.mark.parametrize(
    ("line", "read", "wanted"),
    [("", "no such key", "an altitude above 0 to take off to"), ("altitude_m = 400.0", "400.0", "at most 300, which")],
)
def test_copters_take_off_to_a_given_altitude_that_they_reach(line: str, read: str, wanted: str) -> None:
    text = (SCENARIOS / "copters5.toml").read_text()
    with pytest.raises(ScenarioError, match=f"altitude_m: read {read}, wanted {wanted}"):
        parse(text.replace("altitude_m = 20.0", line, 1), FILE)


def test_lists_are_written_as_tomlkit_writes_them() -> None:
    table = {"trace_s": [0.1, 2e-7, 3.0], "none": [], "rows": [[1, 2], [3, 4]], "names": ['a"b', "c"], "flags": [True]}
    data = {**table, "part": table, "parts": [table, {"x": 1}]}
    assert toml_text(data) == tomlkit.dumps(data)
    assert tomllib.loads(toml_text(data)) == data
