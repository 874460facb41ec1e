"""The three kinds of simulated vehicles for tests that hold for all of them."""

from collections.abc import Callable

from scenarios.keys.part import Flavour
from scenarios.schema import Autopilot
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.shell import Craft, Shell
from tests.support.sim_client import a_vehicle, scenario, shell_of


def copter(flavour: Flavour) -> Shell[Copter]:
    """A multicopter on the ground at START."""
    flown = scenario().model_copy(update={"dynamics": "autopilot", "autopilot": Autopilot(flavour=flavour)})
    return shell_of(flown, Copter)


VEHICLES: dict[str, Callable[[], Shell[Craft]]] = {
    "double_integrator": a_vehicle,
    "ardupilot": lambda: copter("ardupilot"),
    "px4": lambda: copter("px4"),
}
