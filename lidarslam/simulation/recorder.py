"""A sensor on a carrier in a world: scans made one at a time, in any order, with the truth about them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.imu import MEMS_IMU, ImuModel, sample_imu
from lidarslam.simulation.mesh import Caster, Hits, first_ground_triangle
from lidarslam.simulation.motion import Motion, mount_pose
from lidarslam.simulation.noise import bloom, intensities, measure, ranges_in_grass, reflectivity
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import Rays, Sensor, find_sensor
from lidarslam.simulation.world import World, build_world

# Blades have all orientations; on average they reflect half of a beam's power.
_BLADE_COSINE = 0.5


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan and the truth about it; all arrays in the order of the scan's N points.

    The points are exact in float32, stamped at the sweep's start, as the drivers' message headers are. The true ranges
    are those along the rays before noise, edge effects and grass; inf where a point came from its neighbour's surface
    alone.
    """

    scan: Scan
    intensities: NDArray[np.float32]  # (N,) whole numbers from 0 to 255
    true_ranges: FloatArray | None = None  # (N,) or None if unknown
    moving: NDArray[np.bool_] | None = None  # (N,) whether the ray met a mover, or None if unknown


# Simulated time starts at zero, the clocks of drivers at 2024-01-01 00:00:00 UTC. Fixed, so that the same seed gives
# the same bytes; far from zero, so that readers can distinguish offsets from a stamp and readings of the clock.
CLOCK_START_NS = 1_704_067_200 * 10**9


def clock_ns(time: float, start_ns: int = CLOCK_START_NS) -> int:
    """The clock's reading at a simulated time in seconds, to the nanosecond."""
    return start_ns + round(time * 1e9)


def clock_s(time: float, start_ns: int = CLOCK_START_NS) -> float:
    """The same in seconds, the float64 that a reader makes of the nanoseconds."""
    return clock_ns(time, start_ns) / 10**9


@dataclass(frozen=True)
class Rig:
    """The sensor on its carrier, as far as a file format has to know it."""

    driver: str  # whose messages the sensor speaks: "velodyne", "ouster", "hesai" or "livox"
    sweep_s: float  # duration of a sweep
    T_world_lidar_at: Callable[[FloatArray], FloatArray]  # true poses (N, 4, 4) at times (N,), simulated seconds
    imu: ImuSamples | None = None  # on simulated time too; None where none is to be recorded


@dataclass(frozen=True, eq=False)
class Echoes:
    """The truth about one sweep, of all N rays fired, each from the pose at its own time."""

    rays: Rays  # in the LiDAR frame
    times: FloatArray  # (N,) seconds
    origins: FloatArray  # (N, 3) in the world
    directions: FloatArray  # (N, 3) in the world
    hits: Hits


@dataclass(frozen=True, eq=False)
class Simulation:
    """A recording that is made while it is read; a `ScanSequence` that takes no memory but the world's.

    Sweep i starts at i / rate seconds of simulated time and depends on nothing but the attributes and i.
    """

    world: World
    sensor: Sensor
    motion: Motion
    T_body_lidar: FloatArray  # (4, 4) how the sensor is mounted
    scan_count: int
    seed: int = 0  # of the noise
    imu_model: ImuModel = MEMS_IMU  # of the IMU on the LiDAR
    first: int = 0  # number of the sweep that the first scan is of

    @property
    def name(self) -> str:
        """World, sensor and motion."""
        return f"{self.world.name}-{self.world.seed}_{self.sensor.name}_{self.motion.name}-{self.seed}"

    @property
    def stamps(self) -> FloatArray:
        """(N,) the start of each sweep."""
        return np.array(self._sweeps) / self.sensor.rate_hz

    @property
    def _sweeps(self) -> range:
        return range(self.first, self.first + self.scan_count)

    @cached_property
    def ground_truth(self) -> Trajectory:
        """T_world_lidar at the stamps of the scans, exact."""
        return self.ground_truth_at(self.stamps)

    def ground_truth_at(self, stamps: FloatArray) -> Trajectory:
        """T_world_lidar at increasing stamps (N,), exact."""
        return Trajectory(stamps, self.T_world_lidar_at(stamps))

    @cached_property
    def imu(self) -> ImuSamples:
        """The samples of the IMU on the LiDAR, from the first sweep's start to the last one's end."""
        first_s, last_s = (sweep / self.sensor.rate_hz for sweep in (self.first, self._sweeps.stop))
        return sample_imu(self.imu_model, self.T_world_lidar_at, first_s, last_s, self.seed)

    def T_world_lidar_at(self, times: FloatArray) -> FloatArray:
        """(N, 4, 4) at times (N,) in seconds, exact."""
        # Unlike a matrix product this wakes no pool of threads, which takes longer than products so small.
        return np.asarray(np.einsum("nij,jk->nik", self.motion.pose_at(times), self.T_body_lidar))

    @cached_property
    def _caster(self) -> Caster:
        return Caster(self.world)

    def distance_to_surfaces(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) in the world from the nearest static surface."""
        return self._caster.distances(points)

    def __len__(self) -> int:
        return self.scan_count

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; the ones between are not made."""
        for index in self._sweeps[start:stop:step]:
            yield self.scan(index).scan

    def scan(self, index: int, echoes: Echoes | None = None) -> SimulatedScan:
        """One scan with intensities and truth, from the sweep's echoes if they are known already."""
        echoes = echoes or self.echoes(index)
        hits, model, pattern = echoes.hits, self.sensor.ranging, self.sensor.pattern
        rng = np.random.default_rng([self.seed, index])
        ranges, bloomed = bloom(model, hits.ranges, pattern.lasers, pattern.column_angle, rng)
        # A ray that only grazes an edge meets no surface whose slant would matter.
        cosines = np.where(bloomed, 1.0, hits.cosines)
        if self.world.grass is not None:
            ground = np.flatnonzero(~bloomed & (hits.surfaces >= first_ground_triangle(self.world)))
            points = echoes.origins[ground] + ranges[ground, None] * echoes.directions[ground]
            shorter, is_blade = ranges_in_grass(self.world.grass, points, ranges[ground], cosines[ground], rng)
            ranges[ground], cosines[ground[is_blade]] = shorter, _BLADE_COSINE
        shares = reflectivity(hits.surfaces)
        measured = measure(model, ranges, cosines, shares, rng)
        returned = np.flatnonzero(np.isfinite(measured))
        points = echoes.rays.directions[returned] * measured[returned, None]
        scan = Scan(
            points.astype(np.float32).astype(np.float64),
            index / self.sensor.rate_hz,
            echoes.rays.fractions[returned] * self.sensor.period_s,
            echoes.rays.rings[returned] if self.sensor.has_rings else None,
        )
        brightness = intensities(cosines[returned], shares[returned])
        return SimulatedScan(scan, brightness, hits.ranges[returned], hits.moving[returned])

    def echoes(self, index: int) -> Echoes:
        """The true intersections of the rays of one sweep, every one cast from the pose at its own time."""
        rays = self.sensor.pattern.rays(index)
        times = index / self.sensor.rate_hz + rays.fractions * self.sensor.period_s
        # Lasers that fire together share a pose.
        fresh = np.diff(times, prepend=-np.inf) > 0.0
        T_world_lidar = self.T_world_lidar_at(times[fresh])[np.cumsum(fresh) - 1]
        origins = T_world_lidar[:, :3, 3]
        directions = np.einsum("nij,nj->ni", T_world_lidar[:, :3, :3], rays.directions)
        hits = self._caster.cast(origins, directions, times, self.sensor.ranging.max_range_m)
        return Echoes(rays, times, origins, directions, hits)


def simulation_of(
    world: str, sensor: str, carrier: str, mount: str, scans: int, seed: int, speed_mps: float | None = None
) -> Simulation:
    """The simulation of parts by their names; the seed is that of the world, the motion and the noise.

    InputError where there is no such part, or the carrier cannot follow the world's route.
    """
    built = build_world(world, seed)
    motion = motion_along_route(carrier, built, seed, speed_mps)
    return Simulation(built, find_sensor(sensor), motion, mount_pose(mount, motion.sensor_height_m), scans, seed)
