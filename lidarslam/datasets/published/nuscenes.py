"""nuScenes: the sweeps and samples of LIDAR_TOP of one scene, 20 a second.

The tables are read without nuscenes-devkit, which depends on image and plotting libraries. The frame is the
sensor's: x to the right, y forward, z up."""

import mmap
import re
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation
from typing_extensions import TypedDict

from lidarslam.core.errors import InputError
from lidarslam.core.files import reading
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.json_text import parse_json, read_json
from lidarslam.core.text import stays_below
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.published.stamped_files import BinRecording, increasing
from lidarslam.datasets.recording import KITTI_FIELDS, Recording, choose_sequence

_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')
_LIDAR_FILE = re.compile(rb"/LIDAR_TOP/")
_MICROSECOND = 1e-6
_TAIL = 100  # bytes
_LONGEST_RECORD = 1 << 13  # bytes; those of the data set have some hundred

T = TypeVar("T")


class _Scene(TypedDict):
    name: str
    token: str


class _Sample(TypedDict):
    token: str
    scene_token: str


class _Sweep(TypedDict):
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    timestamp: float
    filename: str


class _Pose(TypedDict):
    token: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


_SCENES, _SAMPLES, _POSES = (TypeAdapter(list[_Scene]), TypeAdapter(list[_Sample]), TypeAdapter(list[_Pose]))
_SWEEP, _POSE = TypeAdapter(_Sweep), TypeAdapter(_Pose)


class NuScenesRecording(BinRecording):
    """One scene, given by its name and token: its sweeps in the order of time, samples (key frames) among them."""

    reader = "nuscenes"
    _stored = tuple(PointField(name, "float32") for name in (*KITTI_FIELDS, "ring"))

    def __init__(self, root: Path, config: ReaderConfig, scene: str, version: Path, token: str) -> None:
        tables = version / "sample_data.json"
        samples = {one["token"] for one in _table(version / "sample.json", _SAMPLES) if one["scene_token"] == token}
        data = _select(tables, _LIDAR_FILE, lambda _: True, _SWEEP)
        sweeps = sorted((one for one in data if one["sample_token"] in samples), key=lambda one: one["timestamp"])
        if not sweeps:
            raise InputError(f"{tables}: has no sweep of LIDAR_TOP for the scene; download it again")
        if outside := next((one["filename"] for one in sweeps if not stays_below(one["filename"])), None):
            raise InputError(f"{tables}: names a sweep outside the data set, {outside}; download it again")
        super().__init__(root, config, [root / one["filename"] for one in sweeps])
        self.stamps = np.array([one["timestamp"] for one in sweeps]) * _MICROSECOND
        self._sweeps, self._version, self._scene = sweeps, version, scene
        self._truth_path = version / "ego_pose.json"
        self._notes = (
            f"{scene} of {version.name}, samples and sweeps of LIDAR_TOP.",
            "The scans are motion compensated by the publishers; they have no per-point time and need none.",
        )
        _ = self.ground_truth  # so that a damaged table is an error at once

    @property
    def name(self) -> str:
        """Such as nuscenes_scene-0061."""
        return f"nuscenes_{self._scene}"

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar at every sweep, by the ego poses and the calibration."""
        wanted = {one["ego_pose_token"].encode() for one in self._sweeps}
        ego_poses = _select(self._version / "ego_pose.json", _TOKEN, lambda match: match[1] in wanted, _POSE)
        T_world_ego = self._poses(list(ego_poses), [one["ego_pose_token"] for one in self._sweeps])
        sensors = _table(self._version / "calibrated_sensor.json", _POSES)
        T_ego_lidar = self._poses(sensors, [one["calibrated_sensor_token"] for one in self._sweeps])
        return increasing(self.stamps, T_world_ego @ T_ego_lidar)

    def _poses(self, records: list[_Pose], tokens: list[str]) -> FloatArray:
        by_token = {one["token"]: one for one in records}
        if missing := next((token for token in tokens if token not in by_token), None):
            raise InputError(f"{self._version}: has no pose {missing!r}; download the tables again")
        found = [by_token[token] for token in tokens]
        return _poses(self._version, [one["translation"] for one in found], [one["rotation"] for one in found])


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a scene of the root with `v1.0-*`, samples and sweeps; `config.sequence` is such as 61 for scene-0061."""
    versions = sorted(path.parent for path in source.glob("v1.0-*/scene.json"))
    if not versions:
        raise InputError(f"{source}: expected v1.0-*/scene.json below it, found none; give the root of nuScenes")
    tables = ((version, _table(version / "scene.json", _SCENES)) for version in versions)
    found = {one["name"]: (version, one["token"]) for version, scenes in tables for one in scenes}
    name = choose_sequence(source, sorted(found), config.sequence, "scene")
    return NuScenesRecording(source, config, name, *found[name])


def _table(path: Path, shape: TypeAdapter[list[T]]) -> list[T]:
    with reading(path, "cannot be read", "download the tables again"):
        return read_json(path, shape)


def _select(
    path: Path, pattern: re.Pattern[bytes], wanted: Callable[[re.Match[bytes]], bool], shape: TypeAdapter[T]
) -> Iterator[T]:
    """The records of a large table in which a pattern is found, if the match is wanted."""
    with (
        reading(path, "cannot be read", "download the tables again"),
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text,
    ):
        if not text[-_TAIL:].rstrip().endswith(b"]"):
            raise ValueError("its end is missing")
        for match in pattern.finditer(text):
            if wanted(match):
                start = text.rfind(b"{", max(0, match.start() - _LONGEST_RECORD), match.start())
                end = text.find(b"}", match.end(), match.end() + _LONGEST_RECORD) + 1
                if start < 0 or end == 0:
                    raise ValueError(f"a record has no end within {_LONGEST_RECORD:,} bytes")
                yield parse_json(text[start:end], shape)


def _poses(path: Path, positions: ArrayLike, quaternions: ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) of positions (..., 3) and quaternions (..., 4) of a file, with the scalar first."""
    try:
        t, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
        if not (np.isfinite(t).all() and np.isfinite(q).all()):
            raise ValueError("expected finite positions and quaternions")
        return make_transform(Rotation.from_quat(np.roll(q, -1, axis=-1)).as_matrix(), t)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}; download it again") from error
