"""Estimates and references, read from runs, recordings, trajectory files, maps and point clouds."""

import os
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidarslam.config.settings import Config, load_config, read_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.files import bounded_lines, reading
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.plugins import require_library
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.folders.scan_files import read_pcd, read_ply
from lidarslam.datasets.point_table import coordinates
from lidarslam.datasets.registry import absent, is_recording, open_recording
from lidarslam.simulation.record import GROUND_TRUTH, MADE_BY, README, REFERENCE_MAP
from lidarslam.storage import directory as files
from lidarslam.storage.directory import require_whole
from lidarslam.storage.finished_run import read_trajectory

# Surveys end well within this; squares of much more overflow.
_FARTHEST_M = 1e9

# Of LAS: where the points begin, and their format, in which two bits mark LAZ. There: the place of the table of chunks,
# which begins with its version and their number.
_LAS_HEADER, _IS_LAZ = struct.Struct("<96xI4xB"), 0xC0
_PLACE, _CHUNK_TABLE = struct.Struct("<q"), struct.Struct("<II")
# Read at a time: a damaged header may promise any number of points.
_PIECE_BYTES = 1 << 26


def read_cloud(path: Path) -> FloatArray:
    """The finite points (N, 3), metres, of a .pcd, .ply, .las, .laz or .e57 file, in the file's own frame.

    Coordinates stay in double precision, because surveys count metres from far away. The scans of an E57 file are
    put together by their poses.
    """
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}; name a point cloud")
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path}: not a point cloud that can be read; it must end in {', '.join(_READERS)}")
    with reading(path, f"not a readable {path.suffix[1:].upper()} file", "copy it again or remove it"):
        points = read(path)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{path}: holds no point; choose another file")
    farthest = float(np.abs(points).max())
    if farthest > _FARTHEST_M:
        raise InputError(f"{path}: a point lies {farthest:.3g} m from the origin; expected metres on this planet")
    return points


def _read_las(path: Path) -> FloatArray:
    import laspy

    _require_chunks(path)
    with laspy.open(path) as file:
        at_a_time = max(1, _PIECE_BYTES // file.header.point_format.size)
        pieces = [np.stack([piece.x, piece.y, piece.z], axis=1) for piece in file.chunk_iterator(at_a_time)]
        points = np.concatenate([np.empty((0, 3)), *pieces])
        if len(points) != file.header.point_count:
            raise ValueError(f"{len(points):,} of {file.header.point_count:,} points")
        return points


def _require_chunks(path: Path) -> None:
    """Refuse a LAZ file that counts more chunks than it has bytes: lazrs makes room for all, and ends the program."""
    with path.open("rb") as file:
        header = file.read(_LAS_HEADER.size)
        data, point_format = _LAS_HEADER.unpack(header)
        if not point_format & _IS_LAZ:
            return
        file.seek(data)
        (table,) = _PLACE.unpack(file.read(_PLACE.size))
        if table == -1:  # written at the end by a program that could not go back
            file.seek(-_PLACE.size, os.SEEK_END)
            (table,) = _PLACE.unpack(file.read(_PLACE.size))
        file.seek(table)
        _, chunks = _CHUNK_TABLE.unpack(file.read(_CHUNK_TABLE.size))
        if chunks > path.stat().st_size:
            raise ValueError(f"{chunks:,} chunks")


def _read_e57(path: Path) -> FloatArray:
    file = require_library("pye57", "E57 files need", "pip install 'lidarslam[e57]'").E57(str(path))
    try:
        scans = [file.read_scan(number, ignore_missing_fields=True) for number in range(file.scan_count)]
    finally:
        file.close()
    columns = [np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for scan in scans]
    return np.concatenate([np.empty((0, 3)), *columns])


_READERS: dict[str, Callable[[Path], FloatArray]] = {
    ".ply": lambda path: coordinates(read_ply(path)),
    ".pcd": lambda path: coordinates(read_pcd(path)),
    ".las": _read_las,
    ".laz": _read_las,
    ".e57": _read_e57,
}


_KITTI_COLUMNS = 12
_ADVICE = "name a trajectory with --reference or a map with --reference-map"


@dataclass(frozen=True, eq=False)
class Poses:
    """A trajectory with or without stamps."""

    label: str  # for messages
    trajectory: Trajectory  # of KITTI's camera where the file is in that frame
    has_stamps: bool = True  # not in KITTI's text format: those are made up, and only speeds depend on them
    T_cam_lidar: FloatArray | None = None  # of a KITTI recording, whose pose files are in the camera's frame


@dataclass(frozen=True, eq=False)
class Estimate:
    """A trajectory and its map."""

    poses: Poses  # the trajectory
    run: Path | None = None  # the run directory, None of a bare trajectory
    map_file: Path | None = None  # its map, None when there is none
    source: Path | None = None  # the recording of the run, None of a bare trajectory
    config: Config = field(default_factory=Config)  # of the run; the defaults of a bare trajectory

    def map_points(self) -> FloatArray:
        """The map's points (N, 3)."""
        if self.map_file is None:
            advice = "name it with --map FILE" if self.run is None else "tracking was lost on every scan"
            raise InputError(f"{self.poses.label}: has no map to compare; {advice}")
        return read_cloud(self.map_file)

    def truth(self) -> Poses:
        """The ground truth that came with the recording of the run; InputError where it is not available."""
        if self.source is None:
            raise InputError(f"{self.poses.label}: has no reference; {_ADVICE}")
        if not self.source.exists():
            raise InputError(f"{self.source}: the run's recording is not there any more; {_ADVICE}")
        return _recording_truth(self.source, self.config.reader)


def read_estimate(path: Path | Trajectory, map_file: Path | None = None) -> Estimate:
    """A run directory, or a trajectory, in memory or in TUM or KITTI text, with a map given separately."""
    if isinstance(path, Trajectory):
        return Estimate(Poses("the trajectory", path), map_file=map_file)
    if not path.exists():
        raise InputError(absent(path))
    if not path.is_dir():
        return Estimate(_read_poses(path), map_file=map_file)
    poses, config_file = Poses(str(path), read_trajectory(path)), path / files.CONFIG
    own_map = path / files.MAP_PLY
    chosen_map = map_file or (own_map if own_map.is_file() else None)
    if not config_file.is_file():
        return Estimate(poses, path, chosen_map)
    try:
        source = Path(read_yaml(config_file)[files.RUN_SECTION]["source"])
    except (ConfigError, TypeError, KeyError):
        source = None
    return Estimate(poses, path, chosen_map, source, load_config(config_file))


def read_reference(path: Path | Trajectory, config: ReaderConfig) -> Poses:
    """A trajectory in memory or in TUM or KITTI text, that of a run directory, or the truth of a recording."""
    if isinstance(path, Trajectory):
        return Poses("the reference", path)
    if not path.exists():
        raise InputError(absent(path))
    require_whole(path)
    if (path / files.TRAJECTORY_TUM).is_file():
        return Poses(f"the run {path}", read_trajectory(path))
    if path.is_dir() or is_recording(path):
        return _recording_truth(path, config)
    return _read_poses(path)


def _recording_truth(source: Path, config: ReaderConfig) -> Poses:
    recording = open_recording(source, config)
    truth = recording.ground_truth
    if truth is None:
        raise InputError(f"{source}: came with no ground truth; {_ADVICE}")
    return Poses(f"the ground truth of {source}", truth, T_cam_lidar=recording.T_cam_lidar)


def truth_of_run(run: Path) -> Trajectory | None:
    """The ground truth that came with the recording of a run; None without, or where it is not available."""
    estimate = read_estimate(run)
    with suppress(InputError):
        return estimate.truth().trajectory
    return None


def _read_poses(path: Path) -> Poses:
    rows = (line.split("#", 1)[0].replace(",", " ").split() for line in bounded_lines(path))
    columns = next((len(words) for words in rows if words), 0)
    if columns == _KITTI_COLUMNS:
        return Poses(str(path), Trajectory.from_kitti(path), has_stamps=False)
    return Poses(str(path), read_tum(path))


def pair(estimate: Estimate, reference: Poses) -> tuple[Trajectory, Trajectory]:
    """Both as trajectories with stamps, poses of one and the same sensor.

    KITTI's text has no stamps, so that its poses are matched by their number, and is in the camera's frame: the truth
    of a recording is brought there, and a run is represented by its own trajectory in that format.
    """
    ours, true, T_cam_lidar = estimate.poses.trajectory, reference.trajectory, reference.T_cam_lidar
    if estimate.poses.has_stamps and reference.has_stamps:
        return ours, true
    if not reference.has_stamps and estimate.run is not None and (estimate.run / files.TRAJECTORY_KITTI).is_file():
        ours = Trajectory.from_kitti(estimate.run / files.TRAJECTORY_KITTI, ours.stamps)
    if not estimate.poses.has_stamps and T_cam_lidar is not None:
        true = Trajectory(true.stamps, T_cam_lidar @ true.T_world_lidar @ inverse(T_cam_lidar))
    if len(ours) != len(true):
        raise InputError(
            f"{estimate.poses.label} has {len(ours):,} poses, {reference.label} has {len(true):,}, and KITTI's text"
            " format has no stamps to match them by; name the recording as --reference, or give both as TUM files"
        )
    stamps = ours.stamps if estimate.poses.has_stamps else true.stamps
    return Trajectory(stamps, ours.T_world_lidar), Trajectory(stamps, true.T_world_lidar)


@dataclass(frozen=True, eq=False)
class ReferenceMap:
    """A map to compare with."""

    path: Path  # of its file
    points: FloatArray  # (N, 3) in its own frame
    truth: Trajectory | None = None  # the true trajectory in that frame; None when none is known


def load_reference_map(path: Path) -> ReferenceMap:
    """A map from a file; that of a simulated recording brings its trajectory with it."""
    truth = path.parent / GROUND_TRUTH
    is_simulated = path.name == REFERENCE_MAP and _is_simulated(path.parent) and truth.is_file()
    return ReferenceMap(path, read_cloud(path), read_tum(truth) if is_simulated else None)


def find_reference_map(source: Path) -> ReferenceMap | None:
    """The exact map of a simulated recording, which is in its folder; None of any other."""
    # Of a recording in KITTI's layout, the source may be sequences/NN.
    for folder in [source, *source.resolve().parents[:2]]:
        if (folder / REFERENCE_MAP).is_file() and _is_simulated(folder):
            return load_reference_map(folder / REFERENCE_MAP)
    return None


def _is_simulated(folder: Path) -> bool:
    readme = folder / README
    return readme.is_file() and MADE_BY in readme.read_text(encoding="utf-8", errors="replace")
