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
    is_return,
)
from lidarslam.datasets.point_time_inference import TimedCloud, learn_point_time
from lidarslam.datasets.recording import PointField, PointTime, Recording, RecordingInfo
from lidarslam.datasets.stamps import scan_rate


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

    T_cam_lidar: FloatArray | None = None  # no camera

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        self._folder = folder
        self._config = config
        self._layout = find_layout(folder, config.rate_hz)
        self._read_table = table_reader(self._layout.files)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._folder.resolve().name

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
            # The points' clock is better than an assumed rate: the sweep's first point gives the stamp.
            seconds = values[is_return(points)].astype(np.float64) / UNITS_PER_SECOND[model.unit]
            seconds = seconds[np.isfinite(seconds)]
            if not len(seconds):
                return stamp, None
            stamp = float(seconds[np.abs(seconds - np.median(seconds)) <= CLOCK_LIMIT_S].min())
        return stamp, model.offsets(values, stamp)

    @cached_property
    def _point_time(self) -> PointTimeModel | None:
        """Inferred once, so that all scans are read alike."""
        config = self._config
        if config.time_reference == "none":
            return None
        rate = scan_rate(self._layout.stamps) if self._layout.from_clock else None
        period_s = None if rate is None else 1.0 / rate
        return learn_point_time(self._timed_clouds(), config.time_unit, config.time_reference, period_s)

    def _timed_clouds(self) -> Iterator[TimedCloud]:
        for index, stamp in enumerate(self._layout.stamps):
            try:
                table, points = self._table(index)
            except InputError:
                continue  # counted when it is its turn
            field = find_time_field(scalar_fields(table), self._config.time_field)
            values = None if field is None else table[field][is_return(points)]
            yield TimedCloud(field, values, float(stamp) if self._layout.from_clock else None)

    def describe(self) -> RecordingInfo:
        """What `lidarslam info` prints.

        Raises:
            InputError: no scan can be read.
        """
        faults = Faults()
        index, first, unreadable = first_readable(self._folder, range(len(self)), lambda i: self._read(i, faults))
        table, _ = self._table(index)
        return RecordingInfo(
            reader="scan-folder",
            scans=len(self),
            first=first,
            last_stamp=self._last_stamp(),
            ground_truth=self._layout.truth,
            point_time=PointTime.of_scan(first, self._point_time),
            fields=tuple(PointField(n, str(table.dtype[n].base)) for n in table.dtype.names or ()),
            notes=(*self._layout.notes, *self.warnings, *unreadable.warnings()),
        )

    def _last_stamp(self) -> float:
        """By its points' clock, which may be better than the rate."""
        try:
            return next(self.scans(len(self) - 1)).stamp
        except InputError:
            return float(self._layout.stamps[-1])
