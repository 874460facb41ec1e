"""The three kinds of simulated vehicles for tests that hold for all of them."""

from collections.abc import Callable

from scenarios.schema import Autopilot, Flavour
from sim_vehicles.copter import Copter
from sim_vehicles.vehicle import Vehicle
from tests.sim_client import START, a_vehicle, scenario


def copter(flavour: Flavour) -> Copter:
    """A multicopter on the ground at START."""
    flown = scenario().model_copy(update={"dynamics": "autopilot", "autopilot": Autopilot(flavour=flavour)})
    return Copter(flown, flown.vehicles[0], START)


VEHICLES: dict[str, Callable[[], Vehicle | Copter]] = {
    "plain": a_vehicle,
    "ardupilot": lambda: copter("ardupilot"),
    "px4": lambda: copter("px4"),
}
