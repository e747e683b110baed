"""A sensor on a carrier in a world: scans made one at a time, in any order, with the truth about them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.casting.caster import Caster, Hits
from lidarslam.simulation.casting.grass import ranges_in_grass
from lidarslam.simulation.casting.mesh import first_ground_triangle
from lidarslam.simulation.motion.motions import Motion
from lidarslam.simulation.sensors.noise import bloom, intensities, measure, reflectivity, scan_rng
from lidarslam.simulation.sensors.scan_patterns import Rays
from lidarslam.simulation.sensors.sensor import Sensor
from lidarslam.simulation.world import Grass, World

# Blades stand every way; half of a beam's power is what they reflect on average.
_BLADE_COSINE = 0.5


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan and the truth about it; all arrays in the order of the scan's points.

    Attributes:
        scan: points exact in float32, stamped at the sweep's start, as the drivers' message headers are.
        intensities: (N,) float32, whole numbers from 0 to 255.
        true_ranges: (N,) float64 along the rays that were measured, before noise, edge effects and grass; inf where a
            point came from its neighbour's surface alone. None if unknown.
        moving: (N,) whether the ray met something that moves; None if unknown.
    """

    scan: Scan
    intensities: NDArray[np.float32]
    true_ranges: FloatArray | None = None
    moving: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Echoes:
    """The truth about one sweep, of all N rays fired.

    Attributes:
        rays: in the LiDAR frame.
        times: (N,) seconds.
        origins, directions: (N, 3) of the rays, in the world, each from the pose at its own time.
        hits: what they met.
    """

    rays: Rays
    times: FloatArray
    origins: FloatArray
    directions: FloatArray
    hits: Hits


@dataclass(frozen=True, eq=False)
class Simulation:
    """A recording that is made while it is read; a `ScanSequence` that takes no memory but the world's.

    Scan i starts at i / rate seconds of simulated time.

    Attributes:
        world, sensor, motion: see there.
        T_body_lidar: (4, 4) how the sensor is mounted.
        scan_count: number of scans.
        seed: of the noise.
    """

    world: World
    sensor: Sensor
    motion: Motion
    T_body_lidar: FloatArray
    scan_count: int
    seed: int = 0

    @property
    def name(self) -> str:
        """World, sensor and motion."""
        return f"{self.world.name}-{self.world.seed}_{self.sensor.name}_{self.motion.name}-{self.seed}"

    @property
    def stamps(self) -> FloatArray:
        """(N,) the start of each sweep."""
        return np.arange(self.scan_count) / self.sensor.rate_hz

    @cached_property
    def ground_truth(self) -> Trajectory:
        """T_world_lidar at the stamps of the scans, exact."""
        return self.ground_truth_at(self.stamps)

    def ground_truth_at(self, stamps: FloatArray) -> Trajectory:
        """T_world_lidar at increasing stamps (N,), exact."""
        return Trajectory(stamps, self.T_world_lidar_at(stamps))

    def T_world_lidar_at(self, times: FloatArray) -> FloatArray:
        """(N, 4, 4) at times (N,) in seconds, exact."""
        # Unlike a matrix product this wakes no pool of threads, which takes longer than products so small.
        return np.asarray(np.einsum("nij,jk->nik", self.motion.pose_at(times), self.T_body_lidar))

    @cached_property
    def _caster(self) -> Caster:
        return Caster(self.world)

    def distance_to_surfaces(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) in the world from what stands still there."""
        return self._caster.distances(points)

    def __len__(self) -> int:
        return self.scan_count

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; the ones between are not made."""
        for simulated in self.simulated_scans(start, stop, step):
            yield simulated.scan

    def simulated_scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[SimulatedScan]:
        """The same with intensities and truth."""
        for index in range(self.scan_count)[start:stop:step]:
            yield self.scan(index)

    def scan(self, index: int) -> SimulatedScan:
        """One scan; depends on nothing but the simulation's attributes and the index."""
        echoes = self.echoes(index)
        hits, model = echoes.hits, self.sensor.ranging
        rng = scan_rng(self.seed, index)
        pattern = self.sensor.pattern
        ranges, bloomed = bloom(model, hits.ranges, pattern.lasers, pattern.column_angle, rng)
        # What only grazes an edge meets no surface whose slant would matter.
        cosines = np.where(bloomed, 1.0, hits.cosines)
        if self.world.grass is not None:
            ranges, cosines = self._through_grass(self.world.grass, echoes, ranges, cosines, ~bloomed, rng)
        shares = reflectivity(hits.surfaces)
        measured = measure(model, ranges, cosines, shares, rng)
        returned = np.flatnonzero(np.isfinite(measured))
        points = echoes.rays.directions[returned] * measured[returned, None]
        scan = Scan(
            points.astype(np.float32).astype(np.float64),
            index / self.sensor.rate_hz,
            echoes.rays.fractions[returned] * self.sensor.period_s,
            echoes.rays.rings[returned],
        )
        brightness = intensities(cosines[returned], shares[returned])
        return SimulatedScan(scan, brightness, hits.ranges[returned], hits.moving[returned])

    def _through_grass(
        self,
        grass: Grass,
        echoes: Echoes,
        ranges: FloatArray,
        cosines: FloatArray,
        is_clear: NDArray[np.bool_],
        rng: np.random.Generator,
    ) -> tuple[FloatArray, FloatArray]:
        """Ranges and cosines (N,) of a sweep's rays; of those that meet the ground, some end at a blade before it."""
        ground = np.flatnonzero(is_clear & (echoes.hits.surfaces >= first_ground_triangle(self.world)))
        points = echoes.origins[ground] + ranges[ground, None] * echoes.directions[ground]
        shortened, is_blade = ranges_in_grass(grass, points, ranges[ground], cosines[ground], rng)
        ranges, cosines = ranges.copy(), cosines.copy()
        ranges[ground] = shortened
        cosines[ground[is_blade]] = _BLADE_COSINE
        return ranges, cosines

    def echoes(self, index: int) -> Echoes:
        """What the rays of one sweep meet in truth, every one cast from the pose at its own time."""
        rays = self.sensor.rays(index)
        times = index / self.sensor.rate_hz + rays.fractions * self.sensor.period_s
        # Lasers that fire together share a pose.
        fresh = np.diff(times, prepend=-np.inf) > 0.0
        T_world_lidar = self.T_world_lidar_at(times[fresh])[np.cumsum(fresh) - 1]
        origins = T_world_lidar[:, :3, 3]
        directions = np.einsum("nij,nj->ni", T_world_lidar[:, :3, :3], rays.directions)
        hits = self._caster.cast(origins, directions, times, self.sensor.ranging.max_range_m)
        return Echoes(rays, times, origins, directions, hits)
