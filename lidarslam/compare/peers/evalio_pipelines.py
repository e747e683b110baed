"""Peers that evalio runs; apart from our own pipeline for evalio, the only file that imports evalio.

Every pipeline keeps evalio's defaults except for the changes in `PIPELINES`, and for its voxels where these follow the
size of the scene. evalio expects a sweep in row-major order with a cell for each shot; pipelines that look for features
along the rings are given that, with the azimuth as the column.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.compare.peers.interface import MAX_RANGE_M, Poses, Sweep
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.imu import ImuSamples
from lidarslam.mapping.loam.features import ring_order

Parameters = Mapping[str, bool | int | float | str]

# Nearer points are cells without a return.
_MIN_RANGE_M = 0.1


@dataclass(frozen=True)
class Pipeline:
    """One of evalio's pipelines."""

    name: str  # of the class in `evalio.pipelines`
    parameters: Parameters = field(default_factory=dict)  # changes to its defaults
    compensated: Parameters = field(default_factory=dict)  # further ones for scans that are motion compensated
    voxels_m: Mapping[str, float] = field(default_factory=dict)  # where the maximum range is 100 m
    # middle: a pose belongs to the middle of its sweep; before: to that of the sweep registered before it; elastic: as
    # in `elastic_instants`
    instants: Literal["middle", "before", "elastic"] = "middle"
    by_rings: bool = False  # whether it looks for features along the rings
    needs_imu: bool = False


PIPELINES = {
    "kiss-icp-evalio": Pipeline("KissICP", voxels_m={"voxel_size": 1.0}),
    # Its authors' size outdoors; that of evalio, 0.3 m, is theirs indoors.
    "genz-icp": Pipeline("GenZICP", voxels_m={"voxel_size": 0.6}),
    # In real time it drops work on a busy machine.
    "mad-icp": Pipeline("MadICP", {"realtime": False}),
    "ct-icp": Pipeline(
        "CTICP",
        {"ls_num_threads": os.cpu_count() or 1},
        {"motion_compensation": "NONE", "distance": "POINT_TO_PLANE", "point_to_plane_with_distortion": False},
        {
            "voxel_size": 0.5,
            "sample_voxel_size": 1.5,
            "init_voxel_size": 0.2,
            "init_sample_voxel_size": 1.0,
            "size_voxel_map": 1.0,
            "min_distance_points": 0.1,
        },
        instants="elastic",
    ),
    "loam-evalio": Pipeline("LOAM", by_rings=True),
    "form": Pipeline("FORM", by_rings=True),
    "lio-sam": Pipeline(
        "LioSAM",
        voxels_m={"mappingCornerLeafSize": 0.2, "mappingSurfLeafSize": 0.4, "odometrySurfLeafSize": 0.4},
        instants="before",
        by_rings=True,
        needs_imu=True,
    ),
    "dlio": Pipeline("DLIO", voxels_m={"vf_res": 0.25}, needs_imu=True),
}


class EvalioEstimator:
    """A pipeline of evalio behind the protocol of peers."""

    def __init__(self, pipeline: Pipeline, first: Sweep, imu: ImuSamples | None, range_m: float | None = None) -> None:
        from evalio import pipelines
        from evalio.types import SE3, ImuParams, LidarParams

        self._pipeline = pipeline
        # evalio counts seconds without a sign; a sweep whose stamp is its middle may start before zero.
        self._begin = min(first.start, np.inf if imu is None else float(imu.stamps[0])) - 1.0
        self._shape = _image_shape(first)
        self._T_lidar_imu = np.eye(4) if imu is None or imu.T_lidar_imu is None else imu.T_lidar_imu
        self._sweeps: list[Sweep] = []
        self._saved: list[tuple[float, FloatArray]] = []
        self._native: Any = getattr(pipelines, pipeline.name)()
        changes = {**pipeline.parameters, **(pipeline.compensated if first.is_compensated else {})}
        if range_m is not None:
            changes |= {name: size_m * range_m / MAX_RANGE_M for name, size_m in pipeline.voxels_m.items()}
        # `set_params` sets only the given parameters.
        self._native.set_params({**self._native.default_params(), **changes})
        (rows, columns), near = self._shape, _MIN_RANGE_M if pipeline.by_rings else 0.0
        rate, far = 10.0 if first.is_compensated else 1.0 / (first.end - first.start), range_m or MAX_RANGE_M
        lidar = LidarParams(num_rows=rows, num_columns=columns, min_range=near, max_range=far, rate=rate)
        self._native.set_lidar_params(lidar)
        if imu is not None:
            self._native.set_imu_params(ImuParams.up())
        self._native.set_imu_T_lidar(SE3.from_mat(inverse(self._T_lidar_imu)))
        self._native.initialize()

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """Take the sample with this number."""
        from evalio.types import ImuMeasurement, Stamp

        stamp = Stamp.from_sec(float(samples.stamps[number]) - self._begin)
        self._native.add_imu(ImuMeasurement(stamp, samples.angular_velocities[number], samples.accelerations[number]))

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """Convert a sweep to evalio's points; the registration, still to be called."""
        from evalio.types import LidarMeasurement, Stamp

        self._sweeps.append(sweep)
        points = _by_rings(sweep, self._shape) if self._pipeline.by_rings else _as_recorded(sweep)
        measured = LidarMeasurement(Stamp.from_sec(sweep.start - self._begin), points)

        def register() -> None:
            self._native.add_lidar(measured)
            for stamp, pose in self._native.saved_estimates():
                self._saved.append((stamp.to_sec() + self._begin, pose.to_mat()))
            self._native.saved_features()  # they accumulate otherwise

        return register

    def finish(self) -> Poses:
        """The poses at their instants; CT-ICP on compensated scans is a scan behind, and registers the last again."""
        sweeps, how = self._sweeps, self._pipeline.instants
        starts, middles, ends = np.array([(sweep.start, sweep.middle, sweep.end) for sweep in sweeps]).T
        if how == "elastic" and sweeps[0].is_compensated:
            self.load(sweeps[-1])()
        poses = np.array([pose for _, pose in self._saved]).reshape(-1, 4, 4) @ inverse(self._T_lidar_imu)
        if how == "elastic":
            rows, instants = elastic_instants(starts, middles, ends)
            return Poses(instants, poses[rows])
        # Without repetitions of the one before, as of a sweep that was skipped or came too early.
        repeated = (np.diff(poses, axis=0) == 0.0).all(axis=(1, 2))
        rows = np.flatnonzero(np.concatenate([[True], ~repeated]))
        stamps = np.array([stamp for stamp, _ in self._saved])[rows]
        instants = middles[np.searchsorted(0.5 * (starts[1:] + starts[:-1]), stamps)]
        return Poses(instants, poses[rows]) if how == "middle" else Poses(instants[:-1], poses[rows[1:]])


def elastic_instants(starts: FloatArray, middles: FloatArray, ends: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Which of CT-ICP's saved poses count, and the instants (M,) that they belong to.

    - Sweeps with times: a pose belongs to the start of its sweep. The first sweep is taken rigidly, so that its pose
      belongs to the middle; the pose saved with the second is the first one's again and is left out.
    - Compensated scans, the last of them registered twice: a pose belongs to the scan before.
    """
    if bool((ends <= starts).all()):
        return np.arange(1, len(starts) + 1), starts
    return np.delete(np.arange(len(starts)), 1), np.concatenate([middles[:1], starts[2:]])


def _image_shape(sweep: Sweep) -> tuple[int, int]:
    """Rings, and cells of a ring by the usual step of the azimuth along it."""
    order, rings = ring_order(sweep.scan)
    x, y, _ = sweep.scan.points[order].T
    steps = np.abs(np.diff(np.arctan2(y, x)))[np.diff(rings) == 0]
    steps = steps[(steps > 0.0) & (steps < np.pi)]
    columns = 2.0 * np.pi / float(np.median(steps)) if len(steps) else 1024.0
    return int(rings.max()) + 1, int(np.clip(round(columns), 64, 4096))


def _by_rings(sweep: Sweep, shape: tuple[int, int]) -> list[Any]:
    """A point for each cell of the image, at the origin where there was no return."""
    from evalio.types import Duration, Point

    order, rings = ring_order(sweep.scan)
    points, times = sweep.scan.points[order], _since_start(sweep)[order]
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    columns = ((azimuths + np.pi) / (2.0 * np.pi) * shape[1]).astype(np.intp) % shape[1]
    inside = rings < shape[0]
    cells = rings[inside] * shape[1] + columns[inside]
    filled = np.zeros((shape[0] * shape[1], 4))
    filled[cells] = np.column_stack([points, times])[inside]
    ranges_mm = np.rint(1e3 * np.linalg.norm(filled[:, :3], axis=1)).astype(int)
    return [
        Point(x=x, y=y, z=z, t=Duration.from_sec(t), range=range_mm, row=cell // shape[1], col=cell % shape[1])
        for cell, ((x, y, z, t), range_mm) in enumerate(zip(filled.tolist(), ranges_mm.tolist(), strict=True))
    ]


def _as_recorded(sweep: Sweep) -> list[Any]:
    from evalio.types import Duration, Point

    rows = zip(sweep.scan.points.tolist(), _since_start(sweep).tolist(), strict=True)
    return [Point(x=x, y=y, z=z, t=Duration.from_sec(t)) for (x, y, z), t in rows]


def _since_start(sweep: Sweep) -> FloatArray:
    offsets = sweep.scan.time_offsets
    return np.zeros(len(sweep.scan)) if offsets is None else offsets - offsets.min()
