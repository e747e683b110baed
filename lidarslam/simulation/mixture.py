"""Recordings in variety, for training: worlds, sensors, carriers and mountings, drawn by a seed.

The ingredients are listed here and not taken from the registries: additions there leave the recordings of a
seed, the prepared training data and the figures measured on them unchanged, and are new to the shipped network.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.simulation.recorder import Simulation, simulation_of

# Used in turn.
MIXED_WORLDS = (
    "street", "office", "tunnel", "forest", "hall", "park", "fields", "terrace", "corridor", "stairs", "crowd",
)  # fmt: skip
# How often each is drawn, relative to the others.
SENSOR_WEIGHTS = {
    "vlp-16": 3.0, "hdl-32e": 1.0, "hdl-64e": 1.0, "hdl-64e-calibrated": 1.0, "os0-64": 1.0, "os1-64": 1.5,
    "os1-128": 1.5, "xt32": 1.0, "livox": 0.5, "mid-360": 0.5, "avia": 0.5,
}  # fmt: skip
_CARRIER_WEIGHTS = {
    "car": 1.5, "handheld": 1.5, "legged": 1.0, "tracked": 1.0, "tracked-harsh": 1.0, "drone": 1.0,
}  # fmt: skip
# Worlds with roads, in which a car is at speed from the first scan on.
_ROADS = frozenset({"street", "park", "fields", "terrace"})
# Worlds without room for vehicles.
_NARROW = frozenset({"corridor", "stairs"})
_ON_FOOT = ("handheld", "legged", "drone")
_FAST_WEIGHT = 3.0
_FAST_MPS = (5.0, 30.0)
_MOUNT_WEIGHTS = {"upright": 0.7, "upside-down": 0.15, "tilted": 0.15}
# A mixture's worlds are numbered from here, far from the small seeds of manual trials.
_FIRST_SEED = 1_000_000


@dataclass(frozen=True)
class Ingredients:
    """The names of a recording's parts; `speed_mps` where it is not the carrier's own."""

    world: str
    sensor: str
    carrier: str
    mount: str
    speed_mps: float | None = None


def mixture(recordings: int, scans: int, seed: int, first: int = 0) -> Iterator[Simulation]:
    """Recordings of `scans` scans each; number i of a seed is the same for any `first`."""
    for number in range(first, first + recordings):
        rng = np.random.default_rng([seed, number])
        chosen = _draw(rng, number)
        parts = (chosen.world, chosen.sensor, chosen.carrier, chosen.mount)
        made = simulation_of(*parts, scans, _FIRST_SEED * (seed + 1) + number, chosen.speed_mps)
        start = int(rng.integers(max(1, int(made.motion.duration_s * made.sensor.rate_hz) - scans)))
        yield replace(made, first=start)


def ingredients_of(number: int, seed: int) -> Ingredients:
    """The parts of a recording of a mixture; its world is not built."""
    return _draw(np.random.default_rng([seed, number]), number)


def _draw(rng: np.random.Generator, number: int) -> Ingredients:
    world = MIXED_WORLDS[number % len(MIXED_WORLDS)]
    carriers = _CARRIER_WEIGHTS | ({"car-fast": _FAST_WEIGHT} if world in _ROADS else {})
    if world in _NARROW:
        carriers = {name: carriers[name] for name in _ON_FOOT}
    sensor, carrier, mount = (_pick(rng, weights) for weights in (SENSOR_WEIGHTS, carriers, _MOUNT_WEIGHTS))
    return Ingredients(world, sensor, carrier, mount, float(rng.uniform(*_FAST_MPS)) if carrier == "car-fast" else None)


def _pick(rng: np.random.Generator, weights: dict[str, float]) -> str:
    shares = np.array(list(weights.values()))
    return str(rng.choice(list(weights), p=shares / shares.sum()))
