"""On a machine's first run: loops are compiled side by side in other processes, and kept on disk for this one.

A process compiles one function at a time; one for each part of the pipeline, on a synthetic room, uses the other
cores. After an installation, `python -m lidarslam.pipeline.compile_ahead` compiles all parts, so that the first run
need not; with the names of some, these in its own process.
"""

import subprocess
import sys
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.compiled import is_compiled
from lidarslam.core.geometry import make_transform
from lidarslam.core.scan import Scan, squared_ranges
from lidarslam.core.tasks import bound, usable_cores

_RINGS, _COLUMNS, _SWEEP_S = 16, 900, 0.1
_HALF_ROOM_M = np.array([8.0, 6.0, 2.0])
_STEP = make_transform(np.eye(3), np.array([0.3, 0.0, 0.0]))


@cache
def made_up_scans() -> tuple[Scan, ...]:
    """Three scans of a box by a spinning sensor that moves along x."""
    azimuths, rings = np.meshgrid(np.linspace(-np.pi, np.pi, _COLUMNS, endpoint=False), np.arange(_RINGS))
    elevations = np.deg2rad(2.0 * rings - 15.0)
    rays = np.stack([np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations)])
    rays = rays.reshape(3, -1).T
    offsets = np.tile(np.linspace(0.0, _SWEEP_S, _COLUMNS, endpoint=False), _RINGS)
    scans = []
    for number in range(3):
        sensor = number * _STEP[:3, 3]
        ranges = ((_HALF_ROOM_M * np.copysign(1.0, rays) - sensor) / np.where(rays == 0.0, 1e-9, rays)).min(axis=1)
        points = np.ascontiguousarray(ranges[:, None] * rays)
        scans.append(Scan(points, number * _SWEEP_S, offsets, rings.astype(np.int32).reshape(-1)))
    return tuple(scans)


def _reading() -> None:
    from lidarslam.datasets.mounting import correct_elevation

    as_stored = np.ones((1, 4), dtype=np.float32)
    squared_ranges(Scan.from_raw(correct_elevation(as_stored[:, :3], 0.0), 0.0).points)


def _images() -> None:
    from lidarslam.odometry.config import ImageConfig
    from lidarslam.odometry.images.bird_eye import bird_eye
    from lidarslam.odometry.images.sweep_images import Imager

    shown = Imager(ImageConfig()).images(made_up_scans()[0]).network
    bird_eye(shown.points, shown.normals, 0.0)


def _alignment() -> None:
    from lidarslam.odometry.alignment.alignment import InitialEstimate, align
    from lidarslam.odometry.alignment.sweep_motion import SweepPair
    from lidarslam.odometry.images.sweep_images import SweepImages

    shape = (_RINGS, _COLUMNS)
    points = np.ascontiguousarray(made_up_scans()[0].points.T, dtype=np.float32).reshape(3, *shape)
    normals = -points / np.linalg.norm(points, axis=0)
    images = SweepImages(points, normals, np.zeros(shape, dtype=np.float32), -0.25, 0.25)
    align(InitialEstimate(np.eye(4)), SweepPair(images, images, _SWEEP_S, None))


def _register(method: str) -> None:
    from lidarslam.mapping.config import MappingConfig
    from lidarslam.mapping.motion.prediction import Prior
    from lidarslam.mapping.tracking.mapper import Mapper

    mapper = Mapper(MappingConfig(method=method))
    for scan in made_up_scans():
        mapper.process(mapper.sample(scan), Prior(_STEP, None))


def _surfels() -> None:
    from lidarslam.mapping.surfels.grid import SurfelGrid

    _register("surfels")
    grid, points = SurfelGrid(0.05), made_up_scans()[0].points
    grid.insert(points, np.zeros(len(points)), np.zeros_like(points))
    grid.drop_beyond(np.zeros(3), 5.0)


def _map() -> None:
    from lidarslam.core.thinning import one_per_cell
    from lidarslam.mapping.global_map.global_map import GlobalMap
    from lidarslam.mapping.motion.deskew import move

    global_map = GlobalMap(0.2)
    for number, scan in enumerate(made_up_scans()):
        kept = one_per_cell(scan.points, 0.2)
        points = move(scan.points[kept], np.linspace(0.0, _SWEEP_S, len(kept)), np.zeros(6))
        global_map.add(points, np.linalg.matrix_power(_STEP, number))
    global_map.points()


def _checks() -> None:
    from lidarslam.mapping.consistency import Surfels, shift_profile
    from lidarslam.mapping.global_map.moved_points import Views, seen_through
    from lidarslam.mapping.loops.sparse_submap import SparseSubmap

    points, views = made_up_scans()[0].points, Views(every=1)
    views.add(points, 0)
    seen_through(points, views.placed(np.eye(4)[None]), 0.2)
    surfels = Surfels.of(points)
    shift_profile(surfels, surfels, np.eye(4), np.array([1.0, 0.0, 0.0]))
    SparseSubmap.of(points, 100.0)


class Part(NamedTuple):
    """A part of the pipeline."""

    rehearse: Callable[[], None]  # run it
    modules: tuple[str, ...]  # that hold its loops, below lidarslam


# The loops of registration, whatever the map.
_REGISTRATION = (
    "mapping.registration.iteration",
    "mapping.registration.local_map",
    "mapping.tracking.fit",
    "mapping.surfels.voxel_hash",
)

# In the order in which they are compiled: the longest first.
PARTS = {
    "surfels": Part(_surfels, (*_REGISTRATION, "mapping.surfels.surfel_kernels", "mapping.surfels.surfel_map")),
    "loam": Part(partial(_register, "loam"), (*_REGISTRATION, "mapping.loam.features", "mapping.loam.feature_map")),
    "alignment": Part(_alignment, ("odometry.alignment.point_to_plane", "odometry.alignment.steps")),
    "images": Part(_images, ("odometry.images.projection", "odometry.images.normals", "odometry.images.bird_eye")),
    "reading": Part(_reading, ("core.scan", "datasets.mounting")),
    "map": Part(_map, ("mapping.motion.deskew", "mapping.global_map.voxels")),
    "checks": Part(_checks, ("mapping.global_map.moved_points", "mapping.consistency", "mapping.loops.sparse_submap")),
}
"""The parts whose loops are compiled."""


# The processes start here, so that no package in the user's folder is found first.
_ROOT = Path(__file__).resolve().parents[2]


def parts_of(config: Config) -> list[str]:
    """The names of the parts whose loops a run needs."""
    needed = {"reading", "map", "checks"} | ({"images", "alignment"} if config.odometry.is_learned else set())
    if config.mapping.enabled:
        needed.add(config.mapping.method)
    return [name for name in PARTS if name in needed]


def uncompiled(names: list[str]) -> list[str]:
    """The parts with a loop that is not on disk."""
    modules = {name: [import_module(f"lidarslam.{module}") for module in PARTS[name].modules] for name in names}
    return [name for name in names if not all(is_compiled(module) for module in modules[name])]


class CompileAhead:
    """Compiles the loops that are not on disk yet; a context that ends its processes.

    Loops that fail to compile here are compiled in this process, on their first call.
    """

    def __init__(self, parts: list[str]) -> None:
        self._running: list[subprocess.Popen[bytes]] = []
        self._is_closed = False
        self._pool = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="compile")
        self._done = [self._pool.submit(self._compile, part) for part in uncompiled(parts)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_closed = True
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._running:
            process.kill()
        self._pool.shutdown()

    def wait(self, report: Callable[[str], None]) -> None:
        """Wait for all loops; `report` is called with a line about them."""
        pending = set(self._done)
        while pending:
            report(f"compiling loops, once on this machine ({len(self._done) - len(pending)} of {len(self._done)})")
            _, pending = futures.wait(pending, return_when=FIRST_COMPLETED)

    def _compile(self, part: str) -> None:
        command = [sys.executable, "-m", "lidarslam.pipeline.compile_ahead", part]
        none = subprocess.DEVNULL
        process = subprocess.Popen(command, cwd=_ROOT, stdin=none, stdout=none, stderr=none, start_new_session=True)
        with bound(process):
            self._running.append(process)
            if self._is_closed:
                process.kill()
            process.wait()


def main(parts: list[str]) -> None:
    """Compile some parts here, or all of them side by side."""
    for name in parts:
        PARTS[name].rehearse()
    if not parts:
        with CompileAhead(list(PARTS)) as compiling:
            compiling.wait(print)


if __name__ == "__main__":
    main(sys.argv[1:])
