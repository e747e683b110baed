"""Recordings of Ouster's sensors, decoded by the maker's ouster-sdk: `.osf` files, and `.pcap` files with metadata."""

from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.text import in_common
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.recording import PacketRecording
from lidarslam.datasets.times.point_time import PointTimeModel

# A sensor's metadata is some tens of kilobytes of JSON with the beams' angles.
_LARGEST_METADATA_BYTES = 1 << 20
_BEAM_ANGLES = b"beam_altitude_angles"
_INTENSITIES = ("REFLECTIVITY", "SIGNAL")
_VALID = 1  # of a column's status


def find_metadata(source: Path) -> Path | None:
    """The metadata of an Ouster next to a recording: the file whose name begins most like it, or the only one."""
    folder = source.absolute().parent
    found = {path: in_common(path.stem, source.stem) for path in folder.glob("*.json") if _is_metadata(path)}
    best = max(sorted(found), key=lambda path: found[path], default=None)
    is_alone = len(list(folder.glob(f"*{source.suffix}"))) == 1
    return best if best is not None and (found[best] or is_alone) else None


def _is_metadata(path: Path) -> bool:
    try:
        return path.stat().st_size <= _LARGEST_METADATA_BYTES and _BEAM_ANGLES in path.read_bytes()
    except OSError:
        return False


class OusterRecording(PacketRecording):
    """The sweeps of one sensor, stamped at their first column by the sensor's clock, in the sensor's frame."""

    # It is no extra: it requires a version of rosbags that this program cannot use, and does not need it here.
    library = "ouster.sdk", "packets of an Ouster need", "pip install --no-deps ouster-sdk"
    point_time = PointTimeModel("timestamp", "ns", "relative")

    @cached_property
    def sensor(self) -> Any:
        """The sensor's metadata, a SensorInfo of the library."""
        raise NotImplementedError

    @cached_property
    def _directions(self) -> Any:
        from ouster.sdk.core import XYZLut

        return XYZLut(self.sensor, use_extrinsics=False)

    def _read(self, frame: Any, faults: Faults) -> Scan:  # noqa: ARG002
        valid = (frame.status & _VALID).astype(bool)
        ranges = frame.field("RANGE")
        points = self._directions(np.where(valid, ranges, 0))
        stamps_ns = frame.timestamp.astype(np.int64)
        first_ns = int(stamps_ns[valid].min()) if valid.any() else 0
        offsets = np.broadcast_to((stamps_ns - first_ns) / 1e9, ranges.shape).T
        rings = np.broadcast_to(np.arange(len(ranges))[:, np.newaxis], ranges.shape)
        # Columns one after the other, in the order of firing.
        intensity = next((frame.field(name).T for name in _INTENSITIES if frame.has_field(name)), None)
        times = offsets if self._point_time else None
        return Scan.from_raw(points.transpose(1, 0, 2), first_ns / 1e9, times, rings.T, intensity)

    def _fields(self, item: Any) -> tuple[PointField, ...]:
        return tuple(PointField(name.lower(), str(item.field(name).dtype)) for name in item.fields)

    def _packets_of_imu(self) -> Iterator[Any]:
        """The library's ImuPackets."""
        raise NotImplementedError

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The sensor's own IMU, on the clock of the columns; None where its packets were not recorded."""
        packets = list(self._packets_of_imu())
        if not packets:
            return None
        stamps = np.concatenate([packet.timestamp() for packet in packets]).astype(np.int64) / 1e9
        accelerations = np.concatenate([packet.accel() for packet in packets]).astype(np.float64)
        rates = np.concatenate([packet.gyro() for packet in packets]).astype(np.float64)
        T_sensor_imu = np.array(self.sensor.imu_to_sensor_transform, dtype=np.float64)
        T_sensor_imu[:3, 3] /= 1000.0  # the metadata is in millimetres
        return usable_samples(stamps, rates, accelerations, T_sensor_imu)


def read_sensor(text: str) -> Any:
    """The library's SensorInfo of a metadata text."""
    from ouster.sdk.core import SensorInfo

    try:
        return SensorInfo(text)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"the metadata of an Ouster cannot be read ({error}); copy it again") from error


def frames_of_packets(sensor: Any, contents: Iterable[bytes]) -> Iterator[Any]:
    """The library's LidarFrames of the packets of a sensor, in the order of recording; damaged packets are left out."""
    from ouster.sdk.core import FrameBatcher, LidarFrame

    batcher, frame, is_begun = FrameBatcher(sensor), LidarFrame(sensor), False
    for packet in packets_of("lidar", sensor, contents):
        is_begun = True
        if batcher.batch(packet, frame):
            yield frame
            frame, is_begun = LidarFrame(sensor), False
    if is_begun and frame.status.any():
        yield frame


def packets_of(kind: Literal["lidar", "imu"], sensor: Any, contents: Iterable[bytes]) -> Iterator[Any]:
    """The library's LidarPackets or ImuPackets of a sensor; damaged ones are left out."""
    from ouster.sdk.core import ImuPacket, LidarPacket, PacketFormat

    layout, make = PacketFormat(sensor), {"lidar": LidarPacket, "imu": ImuPacket}[kind]
    size = getattr(layout, f"{kind}_packet_size")
    for content in contents:
        if len(content) >= size:  # early drivers added a byte
            packet = make(layout)
            packet.buf[:] = np.frombuffer(content, np.uint8, size)
            yield packet


class OusterFile(OusterRecording):
    """An `.osf`, or a `.pcap` with its metadata next to it; of several sensors the first."""

    @cached_property
    def _frame_sets(self) -> Any:
        from ouster.sdk import open_source

        try:
            return open_source(str(self._source), collate=False, index=True, **self._metadata)
        except Exception as error:  # of the library's own kinds
            reason = error.get_sub_exception() if hasattr(error, "get_sub_exception") else error
            raise InputError(f"{self._source}: cannot be read by ouster-sdk ({reason}); copy it again") from error

    @property
    def _metadata(self) -> dict[str, list[str]]:
        """Of a capture; an .osf holds its own."""
        metadata = None if self._source.suffix.lower() == ".osf" else find_metadata(self._source)
        return {} if metadata is None else {"meta": [str(metadata)]}

    @cached_property
    def sensor(self) -> Any:
        """See `OusterRecording`."""
        return self._frame_sets.sensor_info[0]

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """That sensors are left out."""
        count = len(self._frame_sets.sensor_info)
        return (f"The file holds {count} sensors; the first is read.",) if count > 1 else ()

    @cached_property
    def _extent(self) -> tuple[int, float]:
        count = len(self._frame_sets.single(0))
        last = next(self._scans(range(max(0, count - 1), count), Faults()), None)
        return count, 0.0 if last is None else last.stamp

    def _items(self, wanted: range, faults: Faults) -> Iterator[Any]:  # noqa: ARG002
        of_sensor = self._frame_sets.single(0)
        stop = min(wanted.stop, len(of_sensor))
        frame_sets = of_sensor[wanted.start : stop : wanted.step] if wanted.start < stop else ()
        return (frame_set[0] for frame_set in frame_sets if frame_set[0] is not None)

    def _packets_of_imu(self) -> Iterator[Any]:
        from ouster.sdk import open_packet_source
        from ouster.sdk.core import ImuPacket

        if self._source.suffix.lower() == ".osf":  # has no packets
            return iter(())
        packets = open_packet_source(str(self._source), **self._metadata)
        return (packet for _, packet in packets if isinstance(packet, ImuPacket))
