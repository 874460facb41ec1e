"""Code that a scenario names: a control law, a vehicle's dynamics, an aircraft of jsbsim. Nothing here runs it."""

from hashlib import sha256
from typing import Annotated, Literal

from pydantic import Field

from scenarios.keys.part import Part, one_fault

CodeName = Annotated[str, Field(pattern=r"^[^:]+\.py:[A-Za-z_][A-Za-z0-9_]*$")]
"""A name in a Python file, whose path is relative to the scenario file."""

AircraftName = Annotated[str, Field(pattern=r"^jsbsim(:[A-Za-z0-9_-]+)?$")]
"""A model of the package jsbsim."""


Dynamics = Annotated[Literal["double_integrator", "autopilot"] | AircraftName | CodeName, one_fault("dynamics")]
NO_LAW = {"controller": None, "linear": None}
"""Keys of `[control]` to clear for a method other than python."""
BUILT_IN = "double_integrator", "autopilot"
"""Dynamics whose response is known, or identified by the station."""


def names_code(dynamics: str) -> bool:
    """Whether dynamics are a function in a Python file."""
    return ".py:" in dynamics


def aircraft_of(dynamics: str) -> str:
    """The model of the package jsbsim that dynamics name; empty if they name none.

    >>> aircraft_of("jsbsim"), aircraft_of("jsbsim:f16"), aircraft_of("my_model.py:step")
    ('t6texan2', 'f16', '')
    """
    package, _, model = dynamics.partition(":")
    return (model or "t6texan2") if package == "jsbsim" else ""


class CodeFile(Part):
    """A Python file that the scenario names, as it was read."""

    name: str
    """Its path, relative to the scenario file."""
    text: str

    @property
    def sha256(self) -> str:
        """Identifies the contents of the file."""
        return sha256(self.text.encode()).hexdigest()
