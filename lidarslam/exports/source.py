"""The recording and the scans of a finished run, as exports read them again."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import choose_scans, take_in
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.motion.deskew import body_velocity, deskew
from lidarslam.storage import directory as files
from lidarslam.storage.directory import SIGMAS
from lidarslam.storage.finished_run import read_statuses, read_trajectory

# Stamps of the trajectory and of the recording are equal but for the text's nine decimals.
_SAME_S = 1e-6
# A motion over an interval longer than this multiple of the median does not describe the sweep.
_GAP = 2.5


def require_new(out: Path, overwrite: bool) -> None:
    """Check that an exported file can be written.

    Raises:
        OutputError: there is a file that is not to be replaced, or a folder.
    """
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; name another place, or remove it")
    if out.exists() and not overwrite:
        raise OutputError(f"{out}: exists; name another file, or replace it with --overwrite")


@dataclass(frozen=True)
class RunSource:
    """A recording, and which of its scans were taken."""

    path: Path
    reader: ReaderConfig
    # start, stop, step: as in `range`
    start: int
    stop: int | None
    step: int


def read_source(run: Path, purpose: str) -> RunSource:
    """The recording of a run; `purpose` ends the message if it is not there.

    Raises:
        InputError: it is unknown, or not there any more.
    """
    file = run / files.CONFIG
    try:
        content = read_yaml(file)
        about, reader = content[files.RUN_SECTION], content.get("reader") or {}
        path, stop = Path(about["source"]), about.get("stop")
        start, step = int(about.get("start", 0)), int(about.get("step", 1))
        source = RunSource(path, ReaderConfig(**reader), start, None if stop is None else int(stop), step)
    except (ConfigError, ValidationError, AttributeError, KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{file}: does not name the recording of the run, which {purpose}") from None
    if not path.exists():
        raise InputError(f"{path}: is not there any more; the run's recording {purpose}")
    return source


@dataclass(frozen=True, eq=False)
class RunScans:
    """The scans of a finished run."""

    run: Path  # its directory
    trajectory: Trajectory  # the final poses
    odometry: Trajectory  # those of the odometry alone, at the same stamps
    sigmas: FloatArray  # (N, 6) standard deviations of the final poses, as `SIGMAS`; NaN where unknown
    lost: FloatArray  # (N,) bool, whether tracking was lost

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
        """The index of each scan, and the scan with its points moved to its stamp, without times.

        Raises:
            InputError: the recording is not there any more, or cannot be read.
        """
        source = read_source(self.run, "is needed for deskewed clouds; leave them out with --no-clouds")
        recording = open_recording(source.path, source.reader)
        chosen = choose_scans(recording, source.path, source.start, source.stop, source.step)
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
    """Read the poses of a run directory.

    Raises:
        InputError: there is no run, or a file of it is damaged.
    """
    trajectory = read_trajectory(run)
    odometry = trajectory
    if (run / files.ODOMETRY_TUM).is_file():
        odometry = read_tum(run / files.ODOMETRY_TUM)
        if not np.array_equal(odometry.stamps, trajectory.stamps):
            raise InputError(f"{run}: {files.ODOMETRY_TUM} and {files.TRAJECTORY_TUM} have different stamps")
    lost = np.array([status is Status.LOST for status in read_statuses(run, len(trajectory))])
    return RunScans(run, trajectory, odometry, _read_sigmas(run, len(trajectory)), lost)


def _read_sigmas(run: Path, poses: int) -> FloatArray:
    """Standard deviations (N, 6), NaN where the table has none; the number of its rows has been checked."""
    unknown = np.full((poses, len(SIGMAS)), np.nan)
    file = run / files.SCANS_CSV
    if not file.is_file():
        return unknown
    with file.open(encoding="utf-8", newline="") as rows:
        try:
            return np.array([[float(row.get(name) or "nan") for name in SIGMAS] for row in csv.DictReader(rows)])
        except ValueError as error:
            raise InputError(f"{file}: not a run's table ({error}); make the run again") from error
