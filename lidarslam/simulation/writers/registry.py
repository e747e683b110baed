"""Which formats a recording can be written in; a writer's module is imported when it is used."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import cast

from lidarslam.core.errors import InputError
from lidarslam.simulation.writers.clock import CLOCK_START_NS
from lidarslam.simulation.writers.interface import Writer


@dataclass(frozen=True)
class Format:
    """One row of the table.

    Attributes:
        module, function: where its `Writer` is.
        layout: what the writer makes, for the recording's README.
        files: the names of it in the recording's folder, as patterns.
        source: which of them to give to `lidarslam run`; None: the folder itself, which always works too.
        clock_start_ns: what the recording's clock reads at the simulated time zero.
    """

    module: str
    function: str
    layout: str
    files: tuple[str, ...]
    source: str | None = None
    clock_start_ns: int = CLOCK_START_NS

    def source_in(self, folder: Path) -> Path:
        """What to give to `lidarslam run` of the recording in that folder."""
        return folder if self.source is None else folder / self.source.format(name=folder.name)


_BAG_MESSAGES = "with the messages of the sensor's own driver, stamped at the start of each sweep"

FORMATS: dict[str, Format] = {
    "kitti": Format(
        "lidarslam.simulation.writers.kitti",
        "write_kitti",
        "the layout of the KITTI odometry benchmark. As there, the scans are motion compensated, here exactly and to"
        " the stamp at the start of the sweep; there is no per-point time; every point lies 0.205 degrees too low,"
        " which readers of KITTI (this one too) correct; and poses/00.txt is in the frame of the camera that calib.txt"
        " describes (Tr)",
        ("sequences", "poses"),
        clock_start_ns=0,
    ),
    "ply": Format(
        "lidarslam.simulation.writers.ply",
        "write_ply_scans",
        "one binary PLY file a scan, with x, y, z in metres, intensity, t in nanoseconds from the scan's stamp, and"
        " ring; timestamps.txt has a stamp a line, seconds since 1970",
        ("scan_*.ply", "timestamps.txt"),
    ),
    "rosbag1": Format(
        "lidarslam.simulation.writers.rosbag",
        "write_rosbag1",
        f"a ROS 1 bag {_BAG_MESSAGES}",
        ("*.bag",),
        source="{name}.bag",
    ),
    "rosbag2": Format(
        "lidarslam.simulation.writers.rosbag",
        "write_rosbag2",
        f"a ROS 2 bag (SQLite) {_BAG_MESSAGES}; the folder is the bag",
        ("metadata.yaml", "*.db3"),
    ),
    "mcap": Format(
        "lidarslam.simulation.writers.rosbag",
        "write_mcap",
        f"a ROS 2 bag (MCAP) {_BAG_MESSAGES}; the folder is the bag, and its .mcap file can be read alone",
        ("metadata.yaml", "*.mcap"),
    ),
}


def find_format(name: str) -> Format:
    """The format of that name.

    Raises:
        InputError: there is no such format.
    """
    if name not in FORMATS:
        raise InputError(f"no recording format is called {name!r}; there are: {', '.join(FORMATS)}")
    return FORMATS[name]


def load_writer(name: str) -> Writer:
    """The writer of a format.

    Raises:
        InputError: there is no such format.
    """
    chosen = find_format(name)
    return cast(Writer, getattr(import_module(chosen.module), chosen.function))
