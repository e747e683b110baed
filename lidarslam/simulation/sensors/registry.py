"""Which sensors there are."""

from lidarslam.core.errors import InputError
from lidarslam.simulation.sensors.sensor import Sensor
from lidarslam.simulation.sensors.table import SENSORS

__all__ = ["Sensor", "find_sensor"]


def find_sensor(name: str) -> Sensor:
    """The sensor of that name.

    Raises:
        InputError: there is no such sensor.
    """
    if name not in SENSORS:
        raise InputError(f"no sensor is called {name!r}; there are: {', '.join(SENSORS)}")
    return SENSORS[name]
