"""Packets of Velodyne's sensors, decoded by velodyne-decoder: those of one sweep, and captures (.pcap)."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.text import reason
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.packets.ouster import OusterFile, find_metadata
from lidarslam.datasets.point_table import PointField, fields_of, raw_cloud
from lidarslam.datasets.recording import PacketRecording, Recording
from lidarslam.datasets.times.point_time import PointTimeModel

# Beyond the range of any model; the library's own limit is less than that of some.
_FARTHEST_M = 1000.0

_StampedCloud = tuple[float, NDArray[np.void]]


class VelodyneCapture(PacketRecording):
    """The sweeps of a .pcap file, stamped by the host at their first packet."""

    library = "velodyne_decoder", "packets of a Velodyne need", "pip install 'lidarslam[velodyne]'"
    point_time = PointTimeModel("time", "s", "relative")

    def _items(self, wanted: range, faults: Faults) -> Iterator[_StampedCloud]:  # noqa: ARG002
        return islice(self._clouds(), wanted.start, wanted.stop, wanted.step)

    def _read(self, item: _StampedCloud, faults: Faults) -> Scan:  # noqa: ARG002
        stamp, table = item
        return raw_cloud(table).scan(stamp, table["time"].astype(np.float64) if self._point_time else None)

    def _clouds(self) -> Iterator[_StampedCloud]:
        import velodyne_decoder

        config = velodyne_decoder.Config(max_range=_FARTHEST_M, timestamp_first_packet=True)
        found = False
        try:
            for stamp, cloud in velodyne_decoder.read_pcap(self._source, config, as_pcl_structs=True):
                if len(cloud):
                    found = True
                    yield stamp.host, cloud
        except Exception as error:  # the library and its reader of captures raise nearly anything
            if found and type(error).__name__ == "NeedData":
                return  # the recording of the capture was cut short
            raise InputError(f"{self._source}: {_reason(self._source, error)}") from error
        if not found:
            raise InputError(
                f"{self._source}: holds no packets of a Velodyne; for an Ouster, put the sensor's metadata beside it as"
                f" {self.name}.json; else play it through the sensor's driver, and record a bag"
            )

    def _fields(self, item: _StampedCloud) -> tuple[PointField, ...]:
        return fields_of(item[1])


def decode_sweep(packets: Sequence[tuple[float, bytes]]) -> _StampedCloud:
    """The host's stamp that the times of the points count from, and the points (N,), of packets with their stamps."""
    import velodyne_decoder

    decoder = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(max_range=_FARTHEST_M))
    sweep = velodyne_decoder.PacketVector([velodyne_decoder.VelodynePacket(*packet) for packet in packets])
    try:
        stamp, cloud = decoder.decode(sweep, as_pcl_structs=True)
    except RuntimeError as error:
        raise InputError(f"packets of a Velodyne cannot be decoded ({error})") from error
    return stamp.host, cloud


def _reason(path: Path, error: Exception) -> str:
    said = reason(error)
    if "tcpdump" in said or type(error).__name__ == "NeedData":
        return f"is no capture that can be read; a .pcapng is converted by `editcap -F pcap {path} {path.stem}.pcap`"
    return f"its packets cannot be decoded ({said}); record it again, or play it through the sensor's driver"


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a capture of a Velodyne's or an Ouster's packets."""
    if not source.is_file():
        raise InputError(f"{source}: expected a file of packets, got a folder")
    if source.suffix.lower() == ".osf" or find_metadata(source) is not None:
        return OusterFile(source, config)
    return VelodyneCapture(source, config)
