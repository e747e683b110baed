"""Short runs of the parts of the pipeline on a made-up room: their loops are compiled, and kept on disk.

`python -m lidarslam.pipeline.rehearsal surfels` runs one of them, `lidarslam.pipeline.compile_ahead` each in a process.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from lidarslam.core.geometry import make_transform
from lidarslam.core.scan import Scan, squared_ranges

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
    from lidarslam.datasets.mounting.rotation import correct_elevation

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


def _surfels() -> None:
    from lidarslam.mapping.config import MappingConfig
    from lidarslam.mapping.motion.prediction import Prior
    from lidarslam.mapping.surfels.grid import SurfelGrid
    from lidarslam.mapping.tracking.mapper import Mapper

    mapper = Mapper(MappingConfig())
    for scan in made_up_scans():
        mapper.process(scan, Prior(_STEP, None))
    grid, points = SurfelGrid(0.5), made_up_scans()[0].points
    grid.insert(points, np.zeros(len(points)), np.zeros_like(points))
    grid.drop_beyond(np.zeros(3), 5.0)


def _loam() -> None:
    from lidarslam.mapping.config import MappingConfig
    from lidarslam.mapping.motion.prediction import Prior
    from lidarslam.mapping.tracking.mapper import Mapper

    mapper = Mapper(MappingConfig(method="loam"))
    for scan in made_up_scans():
        mapper.process(scan, Prior(_STEP, None))


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
    from lidarslam.mapping.global_map.moved_points import Views, seen_through
    from lidarslam.mapping.slides.scan_surfels import Surfels, shift_profile

    points, views = made_up_scans()[0].points, Views(every=1)
    views.add(points, 0)
    seen_through(points, views.placed(np.eye(4)[None]), 0.2)
    surfels = Surfels.of(points)
    shift_profile(surfels, surfels, np.eye(4), np.array([1.0, 0.0, 0.0]))


@dataclass(frozen=True)
class Part:
    """A part of the pipeline."""

    rehearse: Callable[[], None]  # run it
    modules: tuple[str, ...]  # that hold its loops, below lidarslam
    is_late: bool = False  # whether the first scan's result needs none of them


# In the order in which they are compiled: the longest first, late ones last.
PARTS = {
    "surfels": Part(
        _surfels,
        (
            *(f"mapping.surfels.{kind}_kernels" for kind in ("hash", "cell", "correspondence", "side", "surfel")),
            "mapping.registration.linear_kernels",
        ),
    ),
    "loam": Part(
        _loam,
        (
            *(f"mapping.loam.{kind}_kernels" for kind in ("feature", "neighbour")),
            "mapping.registration.linear_kernels",
            "mapping.surfels.hash_kernels",
        ),
    ),
    "alignment": Part(
        _alignment, tuple(f"odometry.alignment.{kind}" for kind in ("residuals", "point_to_plane", "steps"))
    ),
    "images": Part(_images, ("odometry.images.projection", "odometry.images.normals", "odometry.images.bird_eye")),
    "reading": Part(_reading, ("core.scan", "datasets.mounting.rotation")),
    "map": Part(_map, ("mapping.motion.deskew", "mapping.global_map.voxels")),
    "checks": Part(_checks, ("mapping.global_map.moved_points", "mapping.slides.scan_surfels"), is_late=True),
}
"""The parts whose loops are compiled."""


def main(names: list[str]) -> None:
    """Rehearse some parts, or all."""
    for name in names or PARTS:
        PARTS[name].rehearse()


if __name__ == "__main__":
    main(sys.argv[1:])
