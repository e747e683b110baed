"""nuScenes: the sweeps and samples of LIDAR_TOP of one scene, 20 a second.

The tables are read without nuscenes-devkit, which brings image and plotting libraries along. The frame is the
sensor's: x to the right, y forward, z up.
"""

from collections.abc import Iterator
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.file_recording import FileRecording
from lidarslam.datasets.folders.scan_files import read_bin
from lidarslam.datasets.published.nuscenes_tables import read_sweeps, scenes
from lidarslam.datasets.recording import PointField, Recording
from lidarslam.datasets.times.stamps import increasing_rows

_FIELDS = ("x", "y", "z", "intensity", "ring")
_LISTED = 8


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a scene of the root with `v1.0-*`, samples and sweeps; `config.sequence` is its name, or 61 for scene-0061.

    Raises:
        InputError: no such scene, or a table is missing or damaged.
    """
    versions = sorted(path.parent for path in source.glob("v1.0-*/scene.json"))
    if not versions:
        raise InputError(f"{source}: expected v1.0-*/scene.json below it, found none; give the root of nuScenes")
    found = {name: (version, token) for version in versions for name, token in scenes(version).items()}
    name = _scene_name(source, sorted(found), config.sequence)
    return NuScenesRecording(source, config, name, *found[name])


def _scene_name(source: Path, names: list[str], wanted: str | None) -> str:
    if wanted is None and len(names) == 1:
        return names[0]
    name = f"scene-{wanted.zfill(4)}" if wanted is not None and wanted.isdecimal() else wanted
    if name in names:
        return name
    more = f" and {len(names) - _LISTED:,} more" if len(names) > _LISTED else ""
    listed = f"{', '.join(names[:_LISTED])}{more}"
    if wanted is None:
        raise InputError(f"{source}: holds {len(names):,} scenes; choose one with --sequence: {listed}")
    raise InputError(f"{source}: has no scene {wanted!r}; there are: {listed}")


class NuScenesRecording(FileRecording):
    """One scene."""

    reader = "nuscenes"

    def __init__(self, root: Path, config: ReaderConfig, scene: str, version: Path, token: str) -> None:
        sweeps = read_sweeps(version, token)
        super().__init__(root, config, [root / name for name in sweeps.files])
        self._scene, self._version = scene, version
        self.stamps, self._T_world_lidar = sweeps.stamps, sweeps.T_world_lidar

    @property
    def name(self) -> str:
        """Such as nuscenes_scene-0061."""
        return f"nuscenes_{self._scene}"

    @property
    def ground_truth(self) -> Trajectory:
        """T_world_lidar at every sweep, by the ego poses and the calibration."""
        kept = increasing_rows(self.stamps)
        return Trajectory(self.stamps[kept], self._T_world_lidar[kept])

    def _read(self, index: int, faults: Faults) -> Scan:  # noqa: ARG002
        rows = read_bin(self._files[index], len(_FIELDS))
        return Scan.from_raw(rows[:, :3], self.stamps[index], rings=rows[:, 4], intensities=rows[:, 3])

    def _truth_path(self) -> Path:
        return self._version / "ego_pose.json"

    def _fields(self, index: int) -> tuple[PointField, ...]:  # noqa: ARG002
        return tuple(PointField(name, "float32") for name in _FIELDS)

    def _notes(self) -> Iterator[str]:
        yield f"{self._scene} of {self._version.name}, samples and sweeps of LIDAR_TOP."
        yield "The scans are motion compensated by the publishers; they have no per-point time and need none."
