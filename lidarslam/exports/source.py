"""The recording and the scans of a finished run, as exports read them again."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from lidarslam.config.settings import read_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import choose_scans, take_in
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.mapping.motion.deskew import body_velocity, deskew
from lidarslam.storage import directory as files
from lidarslam.storage.directory import SIGMAS
from lidarslam.storage.finished_run import load_map, read_scans, read_summary, read_trajectory

# Stamps of the trajectory and of the recording are equal but for the text's nine decimals.
_SAME_S = 1e-6
# A motion over an interval longer than this multiple of the median does not describe the sweep.
_GAP = 2.5


def require_new(out: Path, overwrite: bool, *runs: Path) -> None:
    """Refuse to replace an exported file unless that is asked for, and the recordings of the runs in any case."""
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; name another place, or remove it")
    for run in runs if out.exists() else ():
        with suppress(InputError):
            source = read_source(run, "").source.resolve()
            if source in (out.resolve(), *out.resolve().parents):
                raise OutputError(f"{out}: belongs to the recording of {run}; name another file")
    if out.exists() and not overwrite:
        raise OutputError(f"{out}: exists; name another file, or replace it with --overwrite")


@dataclass(frozen=True)
class RunSource:
    """The recording of a run, and which of its scans were taken, as in `range`."""

    source: Path
    reader: ReaderConfig
    start: int = 0
    stop: int | None = None
    step: int = 1


def read_map(run: Path) -> tuple[PointCloud, float | None]:
    """The map of a run, which has one, and the edge of its voxels, where it is known."""
    cloud = load_map(run)
    if not len(cloud):
        raise InputError(f"{run}: has no map")
    return cloud, read_summary(run).get("map_voxel_size_m")


_SOURCE = TypeAdapter(RunSource)


def read_source(run: Path, purpose: str) -> RunSource:
    """The recording of a run; `purpose` ends the message if it is not there."""
    file = run / files.CONFIG
    try:
        content = read_yaml(file)
        found = _SOURCE.validate_python({**content[files.RUN_SECTION], "reader": content.get("reader") or {}})
    except (ConfigError, ValidationError, AttributeError, KeyError, TypeError):
        raise InputError(f"{file}: does not name the recording of the run, which {purpose}") from None
    if not found.source.exists():
        raise InputError(f"{found.source}: is not there any more; the run's recording {purpose}")
    return found


@dataclass(frozen=True, eq=False)
class RunScans:
    """The scans of a finished run."""

    run: Path  # its directory
    trajectory: Trajectory  # the final poses
    odometry: Trajectory  # those of the odometry alone, at the same stamps
    sigmas: FloatArray  # (N, 6) standard deviations of the final poses, as `SIGMAS`; NaN where unknown
    lost: NDArray[np.bool_]  # (N,) whether tracking was lost

    @cached_property
    def velocities(self) -> list[FloatArray | None]:
        """Body velocities (6,) before each scan and after the last, N + 1; None across gaps and lost scans."""
        steps = np.diff(self.trajectory.stamps)
        usual = np.median(steps) if len(steps) else 0.0
        velocities: list[FloatArray | None] = [None]
        for number, T_prev_curr in enumerate(self.trajectory.relative_motions()):
            follows = steps[number] <= _GAP * usual and not self.lost[number : number + 2].any()
            velocities.append(body_velocity(T_prev_curr, steps[number]) if follows else None)
        return [*velocities, None]

    def known_velocities(self, number: int) -> list[FloatArray]:
        """Of the two velocities (6,) before and after a scan, those that are known."""
        return [velocity for velocity in self.velocities[number : number + 2] if velocity is not None]

    def deskewed(self) -> Iterator[tuple[int, Scan]]:
        """The index of each scan, and the scan with its points moved to its stamp, without times."""
        of = read_source(self.run, "is needed for deskewed clouds; leave them out with --no-clouds")
        recording = open_recording(of.source, of.reader)
        chosen = choose_scans(recording, of.source, of.start, of.stop, of.step)
        stamps = self.trajectory.stamps
        for scan in take_in(recording, chosen, Faults()):
            index = int(np.searchsorted(stamps, scan.stamp - _SAME_S))
            if index == len(stamps) or abs(stamps[index] - scan.stamp) > _SAME_S:
                continue  # the run was stopped before it, or left it out
            points, known = scan.points, self.known_velocities(index)
            if scan.time_offsets is not None and known:
                points = deskew(points, scan.time_offsets, known[0], known[-1])
            yield index, Scan(points, scan.stamp, None, scan.rings, 0, scan.intensities, scan.colours)


def read_run_scans(run: Path) -> RunScans:
    """Read the poses of a run directory; InputError where there is none, or a file of it is damaged."""
    trajectory = read_trajectory(run)
    odometry = trajectory
    if (run / files.ODOMETRY_TUM).is_file():
        odometry = read_tum(run / files.ODOMETRY_TUM)
        if not np.array_equal(odometry.stamps, trajectory.stamps):
            raise InputError(f"{run}: {files.ODOMETRY_TUM} and {files.TRAJECTORY_TUM} have different stamps")
    table = read_scans(run, len(trajectory))
    sigmas = np.stack([table.numbers(name) for name in SIGMAS], axis=1)
    return RunScans(run, trajectory, odometry, sigmas, table.lost)
