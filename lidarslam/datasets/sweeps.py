"""Sweeps joined from scans that hold a part of one, as drivers of solid-state sensors and of packets publish them."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import CloudRecording, RecordingInfo, scan_indices

# The duration of sweeps whose directions do not recur, and the longest until they do, seconds.
_LONGEST_S, _SLOWEST_TURN_S = 0.1, 0.25
# The time whose scans show whether they do.
LOOKED_AT_S = 2.0 * _SLOWEST_TURN_S
# Share of the cells of a degree that two whole sweeps have in common: 0.9, or 0.35 of every fourth point; parts of a
# sweep and scans of a Mid-360 have 0.1.
_SAME_DIRECTIONS = 0.3
# Scans with points in fewer cells are not compared.
_FEW_CELLS = 20
# No LiDAR publishes faster: the unit of the stamps is wrong.
_LEAST_PERIOD_S = 1e-3

Directions = tuple[float, NDArray[np.int64]]
"""A stamp, and the directions that were seen then."""


class SweepJoiner:
    """Joins consecutive scans to sweeps of equal duration."""

    def __init__(self, sweep_s: float, period_s: float, first_stamp: float) -> None:
        self._sweep_s = sweep_s
        self._begin = first_stamp - 0.5 * period_s  # halfway between two scans, so that jitter moves none
        self._scans: list[Scan] = []
        self.number = 0  # of the sweep that is being joined

    def number_at(self, stamp: float) -> int:
        """The number of the sweep that a scan of this stamp belongs to."""
        return max(0, int((stamp - self._begin) // self._sweep_s))

    def add(self, scan: Scan) -> Scan | None:
        """The sweep before, once a scan of another one arrives; a late scan belongs to the present one."""
        number = max(self.number, self.number_at(scan.stamp))
        done = self.rest() if number != self.number else None
        self.number = number
        self._scans.append(scan)
        return done

    def rest(self) -> Scan | None:
        """The sweep as far as it has arrived."""
        scans, self._scans = self._scans, []
        return joined(scans) if scans else None


def joined(scans: Sequence[Scan]) -> Scan:
    """One scan with the points of several, and the stamp of the middle one: there the pose is known best."""
    if len(scans) == 1:
        return scans[0]
    stamp = scans[len(scans) // 2].stamp
    offsets = [
        scan.stamp - stamp + (np.zeros(len(scan)) if scan.time_offsets is None else scan.time_offsets) for scan in scans
    ]

    def column(name: str) -> Any:
        values = [getattr(scan, name) for scan in scans]
        return None if any(part is None for part in values) else np.concatenate(values)

    return Scan(
        np.concatenate([scan.points for scan in scans]),
        stamp,
        np.concatenate(offsets),
        column("rings"),
        sum(scan.dropped for scan in scans),
        column("intensities"),
        column("colours"),
        sum(scan.untimed for scan in scans),
    )


def directions_of(scan: Scan) -> Directions:
    """The stamp of a scan, and the numbers (C,) of the cells of azimuth and elevation, a degree wide, with points."""
    x, y, z = scan.points.T
    azimuth, elevation = np.floor(np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))]))
    return scan.stamp, np.unique((azimuth * 1000.0 + elevation).astype(np.int64))


def scans_of_a_sweep(scans: Iterable[Directions], period_s: float) -> int:
    """The number of scan periods after which the directions recur, or those of a tenth of a second; 1 below 15 Hz."""
    if round(_LONGEST_S / period_s) < 2:
        return 1
    seen = [(stamp, cells) for stamp, cells in scans if len(cells) >= _FEW_CELLS]
    found = []
    for index, (stamp, here) in enumerate(seen[: (len(seen) + 1) // 2]):
        recurs = (later - stamp for later, there in seen[index + 1 :] if _agree(here, there))
        found.append(next(recurs, np.inf))
    after_s = float(np.median(found)) if found else period_s
    return max(1, round((after_s if after_s < _SLOWEST_TURN_S else _LONGEST_S) / period_s))


def _agree(one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    common = np.intersect1d(one, other, assume_unique=True)
    return len(common) > _SAME_DIRECTIONS * min(len(one), len(other))


class JoinedRecording:
    """A recording whose scans are joined to sweeps of a duration, or as far as consecutive ones see other directions.

    Scans at less than 15 Hz are sweeps unless a duration is set.
    """

    def __init__(self, recorded: CloudRecording, sweep_s: float | Literal["auto"], time_scale: float = 1.0) -> None:
        self.recorded = recorded
        self._setting, self._time_scale = sweep_s, time_scale

    @cached_property
    def _parts(self) -> int:
        """Scans of a sweep."""
        period_s = self.recorded.period_s
        if period_s is None or period_s < _LEAST_PERIOD_S:
            return 1
        if self._setting != "auto":
            return max(1, round(self._setting / period_s))
        with suppress(InputError):  # raised again when the scans are read
            first = islice(self.recorded.scans(faults=Faults()), round(LOOKED_AT_S / period_s))
            return scans_of_a_sweep(map(directions_of, first), period_s)
        return 1

    @property
    def _sweep_s(self) -> float:
        return self._parts * (self.recorded.period_s or 0.0)

    def _joiner(self) -> SweepJoiner:
        return SweepJoiner(self._sweep_s, self._sweep_s / self._parts, self._info.first.stamp)

    @property
    def _is_joined(self) -> bool:
        return self._parts > 1

    @property
    def name(self) -> str:
        """A short name."""
        return self.recorded.name

    def __len__(self) -> int:
        scans = len(self.recorded)
        return min(self._joiner().number_at(self._info.last_stamp) + 1, scans) if self._is_joined else scans

    @property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar at the truth's own stamps."""
        return self.recorded.ground_truth

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """Extrinsic calibration of a KITTI recording."""
        return self.recorded.T_cam_lidar

    @property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU."""
        return self.recorded.imu

    @property
    def warnings(self) -> tuple[str, ...]:
        """Of the recording, and that scans are joined."""
        return (*self.recorded.warnings, *self._notes)

    @property
    def _notes(self) -> tuple[str, ...]:
        note = (
            f"every {self._parts} scans are joined to one sweep of {self._sweep_s:.2g} s, as consecutive ones see"
            " different directions (--set reader.sweep_s=0 joins none)"
        )
        return (note,) if self._is_joined and self._setting == "auto" else ()

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The sweeps with the indices of `range(start, stop, step)`; earlier ones are read, too."""
        if not self._is_joined:
            return map(self._timed, self.recorded.scans(start, stop, step, faults))
        return self._sweeps(scan_indices(len(self), start, stop, step), faults)

    def _sweeps(self, wanted: range, faults: Faults | None) -> Iterator[Scan]:
        joiner = self._joiner()
        for scan in self.recorded.scans(faults=faults):
            number = joiner.number
            sweep = joiner.add(self._timed(scan))
            if sweep is not None and number in wanted:
                yield sweep
            if joiner.number >= wanted.stop:
                return
        sweep = joiner.rest()
        if sweep is not None and joiner.number in wanted:
            yield sweep

    def _timed(self, scan: Scan) -> Scan:
        return scan.with_times_scaled(self._time_scale)

    @cached_property
    def _info(self) -> RecordingInfo:
        return self.recorded.describe()

    def describe(self) -> RecordingInfo:
        """The contents of the recording, its scans being the sweeps."""
        if not self._is_joined:
            return replace(self._info, first=self._timed(self._info.first))
        first = next(self.scans(faults=Faults()))
        return replace(
            self._info,
            scans=len(self),
            first=first,
            last_stamp=first.stamp + (len(self) - 1) * self._sweep_s,
            notes=(*self._info.notes, *self._notes),
        )
