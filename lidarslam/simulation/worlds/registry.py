"""The worlds; a world's module is imported when it is asked for."""

from importlib import import_module
from typing import cast

from lidarslam.simulation.choices import choose
from lidarslam.simulation.world import World

# Each module below lidarslam.simulation.worlds has `build(seed: int) -> World`.
WORLDS: dict[str, str] = {
    "street": "street.street",
    "office": "office.office",
    "tunnel": "tunnel.tunnel",
    "forest": "open_country.forest",
    "hall": "hall.hall",
    "park": "open_country.park",
    "fields": "open_country.fields",
    "terrace": "street.terrace",
    "town": "street.town",
    "corridor": "on_foot.corridor",
    "stairs": "on_foot.stairs",
    "crowd": "on_foot.crowd",
}


def build_world(name: str, seed: int) -> World:
    """The world of that name and seed; the same two give the same world, bit for bit."""
    module = import_module(f"lidarslam.simulation.worlds.{choose('world', name, WORLDS)}")
    return cast(World, module.build(seed))
