"""What is evaluated and what it is held against, read from runs, recordings and trajectory files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.config.settings import Config, load_config
from lidarslam.config.yaml_text import YamlError, read_yaml
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_kitti_poses, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import READERS, open_recording
from lidarslam.resume.unfinished import require_whole
from lidarslam.run import directory as files
from lidarslam.run.finished_run import read_trajectory

# KITTI's LiDAR turned ten times a second; only speeds depend on it.
_KITTI_PERIOD_S = 0.1
_KITTI_COLUMNS = 12


@dataclass(frozen=True, eq=False)
class Poses:
    """A trajectory as it was found.

    Attributes:
        what: it is, in words.
        stamps: (N,), None in KITTI's text format, which has none.
        T_world_lidar: (N, 4, 4); of KITTI's camera where that is what a file holds.
        T_cam_lidar: of a KITTI recording, whose pose files are in the camera's frame.
    """

    what: str
    stamps: FloatArray | None
    T_world_lidar: FloatArray
    T_cam_lidar: FloatArray | None = None

    @classmethod
    def of(cls, what: str, trajectory: Trajectory, T_cam_lidar: FloatArray | None = None) -> "Poses":
        """The poses of a trajectory."""
        return cls(what, trajectory.stamps, trajectory.T_world_lidar, T_cam_lidar)

    def in_camera(self) -> "Poses":
        """The same in the frame of KITTI's camera, as the pose files have them, if there is a camera."""
        if self.T_cam_lidar is None:
            return self
        return Poses(self.what, self.stamps, self.T_cam_lidar @ self.T_world_lidar @ inverse(self.T_cam_lidar))


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is evaluated.

    Attributes:
        poses: the trajectory.
        run: the run directory, None of a bare trajectory.
        map_file: its map, None when there is none.
        source: the recording that the run was made of, None of a bare trajectory.
        config: of the run; the defaults of a bare trajectory.
    """

    poses: Poses
    run: Path | None
    map_file: Path | None
    source: Path | None
    config: Config


def read_estimate(path: Path, map_file: Path | None = None) -> Estimate:
    """A run directory, or a trajectory in TUM or KITTI text with the map given beside it.

    Raises:
        InputError: it is neither, or damaged.
    """
    if not path.exists():
        raise InputError(f"{path}: no such run directory or trajectory file")
    if not path.is_dir():
        return Estimate(read_poses(path), None, map_file, None, Config())
    poses = Poses.of(str(path), read_trajectory(path))
    own_map = path / files.MAP_PLY
    chosen_map = map_file or (own_map if own_map.is_file() else None)
    if not (path / files.CONFIG).is_file():
        return Estimate(poses, path, chosen_map, None, Config())
    return Estimate(poses, path, chosen_map, _source(path / files.CONFIG), load_config(path / files.CONFIG))


def read_reference(path: Path, config: ReaderConfig) -> Poses:
    """A trajectory to compare with: a TUM or KITTI text file, a run directory, or the truth of a recording.

    Raises:
        InputError: it is none of these, is damaged, or the recording came without ground truth.
    """
    if not path.exists():
        raise InputError(f"{path}: no such trajectory, run directory or recording")
    require_whole(path)
    if (path / files.TRAJECTORY_TUM).is_file():
        return Poses.of(f"the run {path}", read_trajectory(path))
    if path.is_dir() or any(reader.recognises(path) for reader in READERS.values()):
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
    return Poses.of(f"the ground truth of {source}", truth, recording.T_cam_lidar)


def read_poses(path: Path) -> Poses:
    """A trajectory file, TUM or KITTI text by its columns.

    Raises:
        InputError: it is damaged.
    """
    if _columns(path) == _KITTI_COLUMNS:
        return Poses(str(path), None, read_kitti_poses(path))
    return Poses.of(str(path), read_tum(path))


def pair(estimate: Estimate, reference: Poses) -> tuple[Trajectory, Trajectory]:
    """Both as trajectories with stamps, poses of one and the same sensor.

    KITTI's text has no stamps, so that its poses are matched by their number, and is in the camera's frame: a
    recording's truth follows it there, and a run is represented by its own trajectory in that format.

    Raises:
        InputError: one has no stamps, and the other not as many poses.
    """
    poses = estimate.poses
    if reference.stamps is None and estimate.run is not None and (estimate.run / files.TRAJECTORY_KITTI).is_file():
        poses = Poses(poses.what, poses.stamps, read_kitti_poses(estimate.run / files.TRAJECTORY_KITTI))
    if poses.stamps is None:
        reference = reference.in_camera()
    stamps = poses.stamps, reference.stamps
    if stamps[0] is not None and stamps[1] is not None:
        return Trajectory(stamps[0], poses.T_world_lidar), Trajectory(stamps[1], reference.T_world_lidar)
    if len(poses.T_world_lidar) != len(reference.T_world_lidar):
        raise InputError(
            f"{poses.what} has {len(poses.T_world_lidar):,} poses, {reference.what} has"
            f" {len(reference.T_world_lidar):,}, and KITTI's text format has no stamps to match them by;"
            " give both as TUM files, or the same poses in both"
        )
    counted: FloatArray = _KITTI_PERIOD_S * np.arange(len(poses.T_world_lidar), dtype=np.float64)
    common = next((s for s in stamps if s is not None), counted)
    return Trajectory(common, poses.T_world_lidar), Trajectory(common, reference.T_world_lidar)


def _columns(path: Path) -> int:
    """How many numbers the first line with any has."""
    try:
        with path.open(encoding="utf-8-sig") as lines:
            rows = (line.split("#", 1)[0].replace(",", " ").split() for line in lines)
            return next((len(words) for words in rows if words), 0)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: neither a TUM nor a KITTI trajectory; it is not text") from error


def _source(config_file: Path) -> Path | None:
    """The recording that config.yaml names."""
    try:
        tree: Any = read_yaml(config_file)
        return Path(tree[files.RUN_SECTION]["source"])
    except (YamlError, TypeError, KeyError):
        return None
