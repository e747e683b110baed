"""Estimates and references, read from runs, recordings, trajectory files and maps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarslam.assessment.reference_cloud import read_cloud
from lidarslam.config.settings import Config, load_config
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory, read_kitti_poses, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import is_recording, open_recording
from lidarslam.datasets.unrecognised import absent
from lidarslam.simulation.record import GROUND_TRUTH, MADE_BY, README, REFERENCE_MAP
from lidarslam.storage import directory as files
from lidarslam.storage.finished_run import read_trajectory
from lidarslam.storage.unfinished import require_whole

# KITTI's LiDAR turns ten times a second; only speeds depend on it.
_KITTI_PERIOD_S = 0.1
_KITTI_COLUMNS = 12


@dataclass(frozen=True, eq=False)
class Poses:
    """A trajectory with or without stamps."""

    label: str  # for messages
    stamps: FloatArray | None  # (N,), None in KITTI's text format
    T_world_lidar: FloatArray  # (N, 4, 4); of KITTI's camera where the file is in that frame
    T_cam_lidar: FloatArray | None = None  # of a KITTI recording, whose pose files are in the camera's frame

    def in_camera(self) -> "Poses":
        """The same in the frame of KITTI's camera, if there is one."""
        if self.T_cam_lidar is None:
            return self
        return Poses(self.label, self.stamps, self.T_cam_lidar @ self.T_world_lidar @ inverse(self.T_cam_lidar))


@dataclass(frozen=True, eq=False)
class Estimate:
    """A trajectory and its map."""

    poses: Poses  # the trajectory
    run: Path | None  # the run directory, None of a bare trajectory
    map_file: Path | None  # its map, None when there is none
    source: Path | None  # the recording of the run, None of a bare trajectory
    config: Config  # of the run; the defaults of a bare trajectory

    def map_points(self) -> FloatArray:
        """The map's points (N, 3).

        Raises:
            InputError: there is no map, or it cannot be read.
        """
        if self.map_file is None:
            advice = "name it with --map FILE" if self.run is None else "tracking was lost on every scan"
            raise InputError(f"{self.poses.label}: has no map to compare; {advice}")
        return read_cloud(self.map_file)


def read_estimate(path: Path | Trajectory, map_file: Path | None = None) -> Estimate:
    """A run directory, or a trajectory, in memory or in TUM or KITTI text, with a map given separately.

    Raises:
        InputError: it is none of these, or damaged.
    """
    if isinstance(path, Trajectory):
        return Estimate(_in_memory(path, "the trajectory"), None, map_file, None, Config())
    if not path.exists():
        raise InputError(absent(path))
    if not path.is_dir():
        return Estimate(read_poses(path), None, map_file, None, Config())
    trajectory, config_file = read_trajectory(path), path / files.CONFIG
    poses = Poses(str(path), trajectory.stamps, trajectory.T_world_lidar)
    own_map = path / files.MAP_PLY
    chosen_map = map_file or (own_map if own_map.is_file() else None)
    if not config_file.is_file():
        return Estimate(poses, path, chosen_map, None, Config())
    try:
        source = Path(read_yaml(config_file)[files.RUN_SECTION]["source"])
    except (ConfigError, TypeError, KeyError):
        source = None
    return Estimate(poses, path, chosen_map, source, load_config(config_file))


def read_reference(path: Path | Trajectory, config: ReaderConfig) -> Poses:
    """A trajectory to compare with: in memory, a TUM or KITTI text file, a run directory, or the truth of a recording.

    Raises:
        InputError: it is none of these, is damaged, or the recording came without ground truth.
    """
    if isinstance(path, Trajectory):
        return _in_memory(path, "the reference")
    if not path.exists():
        raise InputError(absent(path))
    require_whole(path)
    if (path / files.TRAJECTORY_TUM).is_file():
        trajectory = read_trajectory(path)
        return Poses(f"the run {path}", trajectory.stamps, trajectory.T_world_lidar)
    if path.is_dir() or is_recording(path):
        return recording_truth(path, config)
    return read_poses(path)


def recording_truth(source: Path, config: ReaderConfig) -> Poses:
    """The ground truth that came with a recording.

    Raises:
        InputError: the recording cannot be opened, or came without.
    """
    recording = open_recording(source, config)
    truth = recording.ground_truth
    if truth is None:
        raise InputError(
            f"{source}: came with no ground truth; name a trajectory with --reference or a map with --reference-map"
        )
    return Poses(f"the ground truth of {source}", truth.stamps, truth.T_world_lidar, recording.T_cam_lidar)


def truth_of_run(run: Path) -> Trajectory | None:
    """The ground truth that came with the recording of a run; None without, or where it is not available.

    Raises:
        InputError: there is no run, or it is damaged.
    """
    estimate = read_estimate(run)
    if estimate.source is None or not estimate.source.exists():
        return None
    try:
        truth = recording_truth(estimate.source, estimate.config.reader)
    except InputError:
        return None
    return None if truth.stamps is None else Trajectory(truth.stamps, truth.T_world_lidar)


def read_poses(path: Path) -> Poses:
    """A trajectory file, TUM or KITTI text by its columns.

    Raises:
        InputError: it is damaged.
    """
    try:
        with path.open(encoding="utf-8-sig") as lines:
            rows = (line.split("#", 1)[0].replace(",", " ").split() for line in lines)
            columns = next((len(words) for words in rows if words), 0)
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: neither a TUM nor a KITTI trajectory; it is not text. Name a run directory or a trajectory file"
        ) from error
    if columns == _KITTI_COLUMNS:
        return Poses(str(path), None, read_kitti_poses(path))
    trajectory = read_tum(path)
    return Poses(str(path), trajectory.stamps, trajectory.T_world_lidar)


def _in_memory(trajectory: Trajectory, label: str) -> Poses:
    return Poses(label, trajectory.stamps, trajectory.T_world_lidar)


def pair(estimate: Estimate, reference: Poses) -> tuple[Trajectory, Trajectory]:
    """Both as trajectories with stamps, poses of one and the same sensor.

    KITTI's text has no stamps, so that its poses are matched by their number, and is in the camera's frame: the truth
    of a recording is brought there, and a run is represented by its own trajectory in that format.

    Raises:
        InputError: one has no stamps, and the other not as many poses.
    """
    poses = estimate.poses
    if reference.stamps is None and estimate.run is not None and (estimate.run / files.TRAJECTORY_KITTI).is_file():
        poses = Poses(poses.label, poses.stamps, read_kitti_poses(estimate.run / files.TRAJECTORY_KITTI))
    if poses.stamps is None:
        reference = reference.in_camera()
    if poses.stamps is not None and reference.stamps is not None:
        return Trajectory(poses.stamps, poses.T_world_lidar), Trajectory(reference.stamps, reference.T_world_lidar)
    count = len(poses.T_world_lidar)
    if count != len(reference.T_world_lidar):
        raise InputError(
            f"{poses.label} has {count:,} poses, {reference.label} has {len(reference.T_world_lidar):,}, and KITTI's"
            " text format has no stamps to match them by; give both as TUM files, or the same poses in both"
        )
    stamps = poses.stamps if poses.stamps is not None else reference.stamps
    stamps = _KITTI_PERIOD_S * np.arange(count, dtype=np.float64) if stamps is None else stamps
    return Trajectory(stamps, poses.T_world_lidar), Trajectory(stamps, reference.T_world_lidar)


@dataclass(frozen=True, eq=False)
class ReferenceMap:
    """A map to compare with."""

    path: Path  # of its file
    points: FloatArray  # (N, 3) in its own frame
    truth: Trajectory | None = None  # the true trajectory in that frame; None when none is known

    @property
    def label(self) -> str:
        """For messages."""
        return f"{self.path}{'' if self.truth is None else ', the exact map of the simulation'}"


def load_reference_map(path: Path) -> ReferenceMap:
    """A map from a file; that of a simulated recording brings its trajectory with it.

    Raises:
        InputError: the file cannot be read.
    """
    truth = path.parent / GROUND_TRUTH
    is_simulated = path.name == REFERENCE_MAP and _is_simulated(path.parent) and truth.is_file()
    return ReferenceMap(path, read_cloud(path), read_tum(truth) if is_simulated else None)


def find_reference_map(source: Path) -> ReferenceMap | None:
    """The exact map of a simulated recording, which is in its folder; None of any other.

    Raises:
        InputError: it cannot be read.
    """
    # Of a recording in KITTI's layout, the source may be sequences/NN.
    for folder in [source, *source.resolve().parents[:2]]:
        if (folder / REFERENCE_MAP).is_file() and _is_simulated(folder):
            return load_reference_map(folder / REFERENCE_MAP)
    return None


def _is_simulated(folder: Path) -> bool:
    readme = folder / README
    return readme.is_file() and MADE_BY in readme.read_text(encoding="utf-8", errors="replace")
