"""What a writer is given, and what it does with it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.recording.recorder import SimulatedScan


@dataclass(frozen=True)
class Rig:
    """The sensor on its carrier, as far as a file format has to know it.

    Attributes:
        driver: whose messages the sensor speaks: "velodyne", "ouster", "hesai" or "livox".
        sweep_s: how long a sweep takes.
        T_world_lidar_at: the true poses (N, 4, 4) at times (N,), seconds of simulated time.
    """

    driver: str
    sweep_s: float
    T_world_lidar_at: Callable[[FloatArray], FloatArray]


class Writer(Protocol):
    """Puts the scans of a recording into files of one format."""

    def __call__(self, folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
        """Make the folder, which does not exist yet, and write the scans, holding one of them at a time.

        Raises:
            OutputError: the folder cannot be written.
        """
