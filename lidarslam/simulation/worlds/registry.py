"""Which worlds there are; a world's module is imported when it is asked for."""

from importlib import import_module
from typing import cast

from lidarslam.core.errors import InputError
from lidarslam.simulation.world import World

# Each module has `build(seed: int) -> World`.
WORLDS: dict[str, str] = {
    "street": "lidarslam.simulation.worlds.street.street",
    "office": "lidarslam.simulation.worlds.office.office",
    "tunnel": "lidarslam.simulation.worlds.tunnel.tunnel",
    "forest": "lidarslam.simulation.worlds.open_country.forest",
    "hall": "lidarslam.simulation.worlds.hall.hall",
    "park": "lidarslam.simulation.worlds.open_country.park",
    "fields": "lidarslam.simulation.worlds.open_country.fields",
    "terrace": "lidarslam.simulation.worlds.street.terrace",
}


def build_world(name: str, seed: int) -> World:
    """The world of that name and seed; the same two give the same world, bit for bit.

    Raises:
        InputError: there is no such world.
    """
    if name not in WORLDS:
        raise InputError(f"no world is called {name!r}; there are: {', '.join(WORLDS)}")
    return cast(World, import_module(WORLDS[name]).build(seed))
