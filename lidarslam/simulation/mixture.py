"""Recordings in variety, for training: every world, sensor, carrier and mounting, drawn by a seed."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidarslam.core.scan import Scan, ScanSequence
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.carriers import CARRIERS
from lidarslam.simulation.mounts import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensor_table import SENSORS
from lidarslam.simulation.worlds.registry import WORLDS, build_world

# How often each is drawn, relative to the others; those not named are drawn once.
_SENSOR_WEIGHTS = {"vlp-16": 3.0, "hdl-64e": 2.0, "os1-64": 1.5, "os1-128": 1.5}
_CARRIER_WEIGHTS = {"car": 1.5, "handheld": 1.5}
_MOUNT_WEIGHTS = {"upright": 0.7, "upside-down": 0.15, "tilted": 0.15}
# A mixture's worlds are numbered from here, far from the small seeds that people try things out with.
_FIRST_SEED = 1_000_000


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Some consecutive scans of a recording, as a recording of their own.

    Attributes:
        whole: the recording.
        first, count: which of its scans.
    """

    whole: ScanSequence
    first: int
    count: int

    @property
    def name(self) -> str:
        """The recording's, and where in it."""
        return f"{self.whole.name}@{self.first}"

    @property
    def ground_truth(self) -> Trajectory | None:
        """The recording's."""
        return self.whole.ground_truth

    def __len__(self) -> int:
        return self.count

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)` of the excerpt."""
        chosen = range(self.first, self.first + self.count)[start:stop:step]
        return self.whole.scans(chosen.start, chosen.stop, chosen.step)


@dataclass(frozen=True)
class Ingredients:
    """What a recording of a mixture is of, by name."""

    world: str
    sensor: str
    carrier: str
    mount: str


def mixture(recordings: int, scans: int, seed: int, first: int = 0) -> Iterator[Excerpt]:
    """Recordings of so many scans each; number i of a seed is the same whatever comes before it."""
    for number in range(first, first + recordings):
        yield _draw(number, scans, seed)


def ingredients_of(number: int, seed: int) -> Ingredients:
    """What a recording of a mixture is of; its world is not built."""
    return _ingredients(np.random.default_rng([seed, number]), number)


def _ingredients(rng: np.random.Generator, number: int) -> Ingredients:
    return Ingredients(
        world=list(WORLDS)[number % len(WORLDS)],
        sensor=_pick(rng, list(SENSORS), _SENSOR_WEIGHTS),
        carrier=_pick(rng, list(CARRIERS), _CARRIER_WEIGHTS),
        mount=_pick(rng, list(_MOUNT_WEIGHTS), _MOUNT_WEIGHTS),
    )


def _draw(number: int, scans: int, seed: int) -> Excerpt:
    rng = np.random.default_rng([seed, number])
    chosen = _ingredients(rng, number)
    sensor = SENSORS[chosen.sensor]
    world_seed = _FIRST_SEED * (seed + 1) + number
    world = build_world(chosen.world, world_seed)
    motion = motion_along_route(chosen.carrier, world, world_seed)
    lap = int(motion.duration_s * sensor.rate_hz)
    first = int(rng.integers(max(1, lap - scans)))
    T_body_lidar = mount_pose(chosen.mount, motion.sensor_height_m)
    return Excerpt(Simulation(world, sensor, motion, T_body_lidar, first + scans, world_seed), first, scans)


def _pick(rng: np.random.Generator, names: list[str], weights: dict[str, float]) -> str:
    shares = np.array([weights.get(name, 1.0) for name in names])
    return str(rng.choice(names, p=shares / shares.sum()))
