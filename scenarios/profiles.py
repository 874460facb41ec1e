"""Link profiles by name or file: those that ship, and those that `gcs monitor --save-links` wrote."""

import tomllib
from pathlib import Path

from pydantic import ValidationError
from pydantic_core import to_json

from scenarios.errors import ScenarioError
from scenarios.keys.profile import LinkProfile

FOLDER = Path(__file__).parent / "profiles"


def names() -> list[str]:
    """The names of the profiles that ship, sorted."""
    return sorted(file.stem for file in FOLDER.glob("*.toml"))


def load_profile(name: str, beside: Path, key: str) -> LinkProfile:
    """The profile of a name, or in a file relative to the folder of the file `beside`, whose `key` names it.

    Raises ScenarioError.
    """
    path = FOLDER / f"{name}.toml" if name in names() else beside.parent / name
    wanted = f"one of {', '.join(names())}, or a file that gcs monitor --save-links wrote"
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        return LinkProfile.model_validate_json(to_json(data))
    except OSError as error:
        raise ScenarioError(beside, key, f"{name}: {error.strerror}", wanted) from None
    except ValidationError as errors:
        first = errors.errors()[0]
        at = ".".join(str(part) for part in first["loc"])
        raise ScenarioError(beside, key, f"{name}: {at}: {first['msg']}", wanted) from None
    except (ValueError, RecursionError) as error:
        raise ScenarioError(beside, key, f"{name}: {error}", wanted) from None


def dump_profile(profile: LinkProfile) -> str:
    """The profile as TOML text."""
    import tomlkit

    return tomlkit.dumps(profile.model_dump(mode="json", exclude_none=True, exclude_defaults=True))
