"""One run on disk: from a source to a run directory."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evaluation.trajectory_metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam import run_directory as files
from lidarslam.config import Config, dump_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import format_kitti, format_tum, read_tum
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.pipeline import Pipeline, ScanResult
from lidarslam.prefetch import prefetch
from lidarslam.run_directory import RunDirectory
from lidarslam.scan_log import ScanLog
from lidarslam.summary import RunSummary, summarise
from lidarslam.viewer import NullViewer, Viewer
from mapping.config import GlobalMapConfig
from mapping.global_map import GlobalMap
from mapping.map_io import write_cloud
from odometry.consistency import ConsistencyCheck
from odometry.interface import Odometry
from odometry.registry import make_odometry

RerunMode = Literal["off", "save", "spawn"]


@dataclass(frozen=True)
class RunRequest:
    """What is to be run, how, and where it goes.

    Attributes:
        source: the recording.
        out: the run directory.
        config: how it is computed.
        start, stop, step: which scans, as in `range`.
        prior: TUM file of an external odometry, for `odometry.method: external`.
        rerun: no Rerun recording, one in the run directory, or one there and a window.
        pcd: whether the map is written as .pcd too.
        overwrite: whether an earlier run in `out` is replaced.
    """

    source: Path
    out: Path
    config: Config
    start: int = 0
    stop: int | None = None
    step: int = 1
    prior: Path | None = None
    rerun: RerunMode = "off"
    pcd: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class RunOutcome:
    """What a run came to; `metrics` when the recording came with ground truth for it."""

    summary: RunSummary
    metrics: TrajectoryMetrics | None


Progress = Callable[[int, int, ScanResult], None]
"""Called after every scan with its number from 1, how many there are, and what became of it."""


def execute(request: RunRequest, progress: Progress) -> RunOutcome:
    """Run, and write the run directory.

    Raises:
        LidarSlamError: the source, the configuration or the output directory is not usable.
    """
    recording = open_recording(request.source, request.config.reader)
    chosen = range(len(recording))[request.start : request.stop : request.step]
    if not chosen:
        raise InputError(
            f"{request.source}: none of its {len(recording)} scans is left after --start, --stop and --step"
        )
    with ExitStack() as stack:
        odometry = _make_odometry(request)
        stack.callback(odometry.close)
        directory = RunDirectory.create(request.out, request.overwrite)
        directory.write_text(files.CONFIG, dump_yaml(request.config, _describe(request)))
        log = stack.enter_context(ScanLog.open(directory))
        viewer = _make_viewer(request, recording, directory)
        stack.callback(viewer.close)
        pipeline = Pipeline(odometry, ConsistencyCheck(request.config.odometry.consistency), request.config.global_map)
        scans = in_order(recording.scans(chosen.start, chosen.stop, chosen.step))
        total_ms = _process(pipeline, scans, recording, log, viewer, lambda n, r: progress(n, len(chosen), r))
        if not len(log):
            raise InputError(f"{request.source}: no scan could be used")
        metrics = _write_trajectories(directory, recording, log)
        map_points = _write_map(directory, pipeline.global_map, request.config.global_map, request.pcd)
    voxel_size_m = None if pipeline.global_map is None else pipeline.global_map.voxel_size_m
    summary = summarise(log, total_ms, map_points, voxel_size_m, len(chosen) - len(log))
    directory.write_json(files.SUMMARY, summary.to_json())
    return RunOutcome(summary, metrics)


def in_order(scans: Iterable[Scan]) -> Iterator[Scan]:
    """The scans whose stamps increase; no trajectory could hold the others."""
    latest = -np.inf
    for scan in scans:
        if scan.stamp > latest:
            latest = scan.stamp
            yield scan


def _process(
    pipeline: Pipeline,
    scans: Iterable[Scan],
    recording: Recording,
    log: ScanLog,
    viewer: Viewer,
    progress: Callable[[int, ScanResult], None],
) -> list[float]:
    """Take every scan through the pipeline; the wall time of each, milliseconds."""
    total_ms = []
    finished = time.perf_counter()
    for index, result in enumerate(pipeline.run(prefetch(scans))):
        if index == 0:
            _show_reference(viewer, recording.ground_truth, result.stamp)
        log.add(result)
        viewer.show_scan(index, result)
        if viewer.wants_map(index) and pipeline.global_map is not None:
            viewer.show_map(pipeline.global_map.points())
        progress(index + 1, result)
        last, finished = finished, time.perf_counter()
        total_ms.append(1e3 * (finished - last))
    return total_ms


def _make_odometry(request: RunRequest) -> Odometry:
    config = request.config.odometry
    if config.method == "constant-velocity":
        raise ConfigError(
            "constant-velocity only predicts; without scan-to-map refinement it would stand still."
            " Choose --odometry kiss-icp, or give a trajectory with --prior"
        )
    return make_odometry(config, None if request.prior is None else read_tum(request.prior))


def _make_viewer(request: RunRequest, recording: Recording, directory: RunDirectory) -> Viewer:
    if request.rerun == "off":
        return NullViewer()
    from lidarslam.rerun_viewer import RerunViewer

    return RerunViewer(recording.name, request.config.viewer, directory[files.RERUN], request.rerun == "spawn")


def _describe(request: RunRequest) -> dict[str, Any]:
    """What was run, for config.yaml."""
    return {
        "version": version("lidarslam"),
        "source": str(request.source.resolve()),
        "start": request.start,
        "stop": request.stop,
        "step": request.step,
        "prior": None if request.prior is None else str(request.prior.resolve()),
    }


def _show_reference(viewer: Viewer, ground_truth: Trajectory | None, first_stamp: float) -> None:
    """Show the truth in the run's world: where both have the first scan, they coincide."""
    if ground_truth is None or len(ground_truth) < 2:
        return
    nearest = np.clip(first_stamp, ground_truth.stamps[0], ground_truth.stamps[-1])
    T_truth_first = ground_truth.at(np.array([nearest]))[0]
    viewer.show_reference(ground_truth.transformed(inverse(T_truth_first)))


def _write_trajectories(directory: RunDirectory, recording: Recording, log: ScanLog) -> TrajectoryMetrics | None:
    trajectory = log.trajectory
    directory.write_text(files.TRAJECTORY_TUM, format_tum(trajectory))
    directory.write_text(files.ODOMETRY_TUM, format_tum(log.odometry))
    poses = trajectory.T_world_lidar
    if recording.T_cam_lidar is not None:  # the devkit compares camera poses
        poses = recording.T_cam_lidar @ poses @ inverse(recording.T_cam_lidar)
    directory.write_text(files.TRAJECTORY_KITTI, format_kitti(poses))
    if recording.ground_truth is None:
        return None
    try:
        metrics = evaluate_trajectory(trajectory, recording.ground_truth)
    except InputError as error:
        log.warn(f"no metrics: {error}")
        return None
    directory.write_json(files.METRICS, metrics.to_json())
    return metrics


def _write_map(directory: RunDirectory, global_map: GlobalMap | None, config: GlobalMapConfig, pcd: bool) -> int:
    """Write the map; how many points it has."""
    if global_map is None:
        return 0
    cloud = global_map.cloud(config.normal_neighbours, config.min_hits)
    for name in (files.MAP_PLY, files.MAP_PCD) if pcd else (files.MAP_PLY,):
        with directory.replacing(name) as path:
            write_cloud(path, cloud)
    return len(cloud)
