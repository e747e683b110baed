"""Sweeps joined from scans that hold a part of one, as drivers of solid-state sensors and of packets publish them."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.scan import Scan

# The duration of sweeps whose directions do not recur, and the longest until they do, seconds.
_LONGEST_S, _SLOWEST_TURN_S = 0.1, 0.25
# The time whose scans show whether they do.
LOOKED_AT_S = 2.0 * _SLOWEST_TURN_S
# Share of the cells of a degree that two whole sweeps have in common: 0.9, or 0.35 of every fourth point; parts of a
# sweep and scans of a Mid-360 have 0.1.
_SAME_DIRECTIONS = 0.3
# Scans with points in fewer cells are not compared.
_FEW_CELLS = 20

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
