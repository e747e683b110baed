"""Packets in a file of their own: `.pcap` captures and Ouster's `.osf`."""

from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.packets.ouster import OusterFile, find_metadata
from lidarslam.datasets.packets.velodyne import VelodyneCapture
from lidarslam.datasets.recording import Recording


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a capture of a Velodyne's or an Ouster's packets.

    Raises:
        ConfigError: the library that decodes them is not installed.
        InputError: the source is no file, or of another sensor.
    """
    if not source.is_file():
        raise InputError(f"{source}: expected a file of packets, got a folder")
    if source.suffix.lower() == ".osf" or find_metadata(source) is not None:
        return OusterFile(source, config)
    return VelodyneCapture(source, config)
