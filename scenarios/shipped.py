"""Shipped scenarios by name, and new ones: a copy of a shipped one, or columns of vehicles."""

from collections.abc import Sequence
from pathlib import Path

from scenarios.networks import ids_of

FOLDER = Path(__file__).parent
PROFILES = FOLDER / "profiles"
SCHEMA = FOLDER / "scenario.schema.json"
_SCHEMA_LINE = f"#:schema ./{SCHEMA.name}"
_SPACING_M, _ASIDE_M, _SPEED_M_S = 40.0, 40.0, 25.0
_ERRORS_M = (3.0, -2.0), (-2.0, 2.0), (1.0, 3.0), (-3.0, -1.0)
"""Initial offsets (north, east) of a new scenario's vehicles from their places, used in turn."""


def names(folder: Path = FOLDER) -> list[str]:
    """The names of the scenarios that ship, or of the files of another folder, sorted."""
    return sorted(file.stem for file in folder.glob("*.toml"))


def located(text: str) -> Path:
    """The scenario file that `text` names: a path, or the name of a shipped scenario if no such file exists."""
    named = FOLDER / f"{text}.toml"
    return named if text in names() and not Path(text).is_file() else Path(text)


def description(name: str, folder: Path = FOLDER) -> str:
    """The first sentence of the comment at the top of a shipped scenario, or of another file of a folder."""
    lines = (folder / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.lstrip("# ") for line in lines if line.startswith("# "))
    sentence, dot, _ = comment.partition(". ")
    return sentence + dot.strip()


def copied(name: str, new_name: str) -> str:
    """The text of a shipped scenario under a new name."""
    text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    lines = text.replace(f'name = "{name}"', f'name = "{new_name}"').splitlines()
    return "\n".join([_SCHEMA_LINE, *lines[1:]]) + "\n"


def columns(new_name: str, count: int, length: int) -> str:
    """The text of a scenario with `count` columns of `length` vehicles, side by side.

    Each vehicle follows the one in front of it; the head of a column follows the head of the column to its left. A
    single column is staggered: each vehicle flies behind and to the right of the one in front.
    """
    shape = f"A chain of {length}: each vehicle follows the one in front of it."
    if count > 1:
        shape = f"{count} columns of {length}: the heads of the columns follow the head to their left."
    ids = ids_of(count * length)
    vehicles = "\n".join(_vehicle(ids, k, length, alone=count == 1) for k in range(len(ids)))
    return f"""\
{_SCHEMA_LINE}
# {shape}
# Every key, with its unit, default and bounds: docs/reference/scenario.md; editors that know TOML show them too.
name = "{new_name}"
seed = 1           # of everything random: links, clocks, starting phases
duration_s = 30.0  # of the flight

# The course, north and east. More entries make turns; each is a step of the wanted velocity.
nominal_velocity = [{{ from_s = 0.0, velocity_ne_m_s = [{_SPEED_M_S}, 0.0] }}]

# Who follows whom, at which offset (m, north and east of the vehicle in front), and where each vehicle starts.
vehicles = [
{vehicles}
]

[control]
delay_margin_s = 0.3  # the loop delay that the gains must tolerate; `gcs design` shows what it costs

[links]  # the same for every vehicle; [[links.vehicles]] makes exceptions
up = {{ delay_s = 0.02 }}    # telemetry, one way
down = {{ delay_s = 0.02 }}  # set-points, one way

# [limits]  # what the vehicles can fly
# acceleration_max_m_s2 = 20.0
"""


def _vehicle(ids: Sequence[int], k: int, length: int, *, alone: bool) -> str:
    column, rank = divmod(k, length)
    aside = rank * _ASIDE_M if alone else column * _ASIDE_M
    north_m, east_m = -_SPACING_M * rank, aside
    if k == 0:
        return f"    {{ system_id = 1, position_ne_m = [0, 0], velocity_ne_m_s = [{_SPEED_M_S:g}, 0] }},"
    if rank:
        follows, offset = ids[k - 1], (-_SPACING_M, _ASIDE_M if alone else 0.0)
    else:
        follows, offset = ids[k - length], (0.0, _ASIDE_M)
    wrong_north_m, wrong_east_m = _ERRORS_M[k % len(_ERRORS_M)]
    return (
        f"    {{ system_id = {ids[k]}, follows = {follows}, offset_ne_m = [{offset[0]:g}, {offset[1]:g}], "
        f"position_ne_m = [{north_m + wrong_north_m:g}, {east_m + wrong_east_m:g}], "
        f"velocity_ne_m_s = [{_SPEED_M_S:g}, 0] }},"
    )
