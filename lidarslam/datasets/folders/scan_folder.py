"""A folder of scan files: `.bin`, `.pcd`, `.ply` or `.npy`, one sweep each."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import NO_POINT_TIME, Faults, first_readable, readable_scans
from lidarslam.datasets.folders.formats import table_reader
from lidarslam.datasets.folders.layout import find_layout
from lidarslam.datasets.folders.point_table import coordinates, scalar_fields
from lidarslam.datasets.folders.scan_files import scan_indices
from lidarslam.datasets.point_time import (
    CLOCK_LIMIT_S,
    UNITS_PER_SECOND,
    PointTimeModel,
    find_ring_field,
    find_time_field,
    infer_point_time,
)
from lidarslam.datasets.recording import PointField, PointTime, Recording, RecordingInfo
from lidarslam.datasets.stamps import scan_rate

# How many scans may be without usable point times before the recording counts as having none.
_SCANS_LOOKED_AT = 10


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a folder of scans.

    Raises:
        InputError: it holds no scans, or its stamp file does not go with them.
    """
    if not source.is_dir():
        raise InputError(f"{source}: expected a folder of scans, got a file; give the folder it lies in")
    return ScanFolderRecording(source, config)


class ScanFolderRecording:
    """The scans of one folder; implements `Recording`."""

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        self._folder = folder
        self._config = config
        self._layout = find_layout(folder, config.rate_hz)
        self._read_table = table_reader(self._layout.files)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._folder.resolve().name

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """There is no camera."""
        return None

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The TUM file ground_truth.tum, groundtruth.tum or the like, in the folder or the one above.

        Raises:
            InputError: the file is damaged.
        """
        return None if self._layout.truth is None else read_tum(self._layout.truth)

    def __len__(self) -> int:
        return len(self._layout.files)

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`.

        Raises:
            InputError: the range makes no sense, or a scan file is damaged and `faults` is None.
        """
        counted = Faults() if faults is None else faults
        indices = scan_indices(len(self), start, stop, step)
        return readable_scans(indices, lambda index: self._read(index, counted), faults)

    def _table(self, index: int) -> tuple[NDArray[np.void], FloatArray]:
        path = self._layout.files[index]
        table = self._read_table(path)
        try:
            return table, coordinates(table)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None

    @property
    def warnings(self) -> tuple[str, ...]:
        """How the stamps were mended."""
        return self._layout.warnings

    def _read(self, index: int, faults: Faults) -> Scan:
        table, points = self._table(index)
        stamp, offsets = self._stamp_and_offsets(index, table, points)
        ring_field = find_ring_field(scalar_fields(table))
        scan = Scan.from_raw(points, stamp, offsets, None if ring_field is None else table[ring_field])
        if self._point_time is not None and scan.time_offsets is None and len(scan):
            faults.note(NO_POINT_TIME, str(self._layout.files[index]))
        return scan

    def _stamp_and_offsets(
        self, index: int, table: NDArray[np.void], points: FloatArray
    ) -> tuple[float, FloatArray | None]:
        stamp, model = float(self._layout.stamps[index]), self._point_time
        if model is None or not len(table) or model.field not in scalar_fields(table):
            return stamp, None
        values = table[model.field]
        if model.reference == "absolute" and not self._layout.from_clock:
            # The points know the time better than an assumed rate: the sweep's first one gives the stamp.
            earliest = _earliest_s(values[_usable(points, values)], model)
            if earliest is None:
                return stamp, None
            stamp = earliest
        return stamp, model.offsets(values, stamp)

    @cached_property
    def _point_time(self) -> PointTimeModel | None:
        """Inferred once, from the first scan whose points have usable times, so that all scans are read alike."""
        config = self._config
        if config.time_reference == "none":
            return None
        rate = scan_rate(self._layout.stamps) if self._layout.from_clock else None
        for index in self._scans_to_infer_from():
            try:
                table, points = self._table(index)
            except InputError:
                continue  # counted when it is its turn
            field = find_time_field(scalar_fields(table), config.time_field)
            if field is None:
                return None
            values = table[field][_usable(points, table[field])]
            stamp = float(self._layout.stamps[index]) if self._layout.from_clock else None
            period_s = None if rate is None else 1.0 / rate
            model = infer_point_time(field, values, stamp, config.time_unit, config.time_reference, period_s=period_s)
            if model is not None:
                return model
        return None

    def _scans_to_infer_from(self) -> list[int]:
        """The first scans, but later ones where stamps begin at zero, next to which all times look relative."""
        stamps = self._layout.stamps
        telling = np.abs(stamps) > (2 * CLOCK_LIMIT_S if self._layout.from_clock else np.inf)
        rows = np.flatnonzero(telling if telling.any() else np.isfinite(stamps))
        return [int(row) for row in rows[:_SCANS_LOOKED_AT]]

    def describe(self) -> RecordingInfo:
        """What `lidarslam info` prints.

        Raises:
            InputError: no scan can be read.
        """
        faults = Faults()
        index, first, unreadable = first_readable(self._folder, range(len(self)), lambda i: self._read(i, faults))
        table, _ = self._table(index)
        first_stamp, last_stamp = first.stamp, self._last_stamp()
        duration_s = last_stamp - first_stamp
        return RecordingInfo(
            reader="scan-folder",
            scans=len(self),
            first_stamp=first_stamp,
            duration_s=duration_s,
            rate_hz=(len(self) - 1) / duration_s if duration_s > 0.0 else None,
            points_per_scan=len(first),
            dropped_points=first.dropped,
            has_rings=first.rings is not None,
            ground_truth=self._layout.truth,
            point_time=self._describe_point_time(first),
            fields=tuple(PointField(n, str(table.dtype[n].base)) for n in table.dtype.names or ()),
            notes=(*self._layout.notes, *self.warnings, *unreadable.warnings()),
        )

    def _last_stamp(self) -> float:
        """Of the last scan, which its points may tell better than the rate."""
        try:
            return next(self.scans(len(self) - 1)).stamp
        except InputError:
            return float(self._layout.stamps[-1])

    def _describe_point_time(self, scan: Scan) -> PointTime | None:
        model, offsets = self._point_time, scan.time_offsets
        if model is None or offsets is None or not len(offsets):
            return None
        return PointTime(model.field, model.unit, model.reference, float(offsets.min()), float(offsets.max()))


def _usable(points: FloatArray, values: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Mask of the points that are returns of the laser; drivers leave any time they like in the others."""
    usable = np.isfinite(points).all(axis=1) & np.asarray(points.any(axis=1))
    return np.asarray(usable & np.isfinite(values.astype(np.float64)))


def _earliest_s(values: NDArray[np.generic], model: PointTimeModel) -> float | None:
    """The earliest clock reading of a scan in seconds, single stray ones left out; None without any."""
    seconds = values.astype(np.float64) / UNITS_PER_SECOND[model.unit]
    if not len(seconds):
        return None
    return float(seconds[np.abs(seconds - np.median(seconds)) <= CLOCK_LIMIT_S].min())
