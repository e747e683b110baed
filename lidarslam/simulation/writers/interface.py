"""The interface of writers, and the clock of a recording."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.simulation.recorder import SimulatedScan

# Simulated time starts at zero, the clocks of drivers at 2024-01-01 00:00:00 UTC. Fixed, so that the same seed gives
# the same bytes; far from zero, so that readers can tell offsets from a stamp from readings of the clock.
CLOCK_START_NS = 1_704_067_200 * 10**9


def clock_ns(time: float, start_ns: int = CLOCK_START_NS) -> int:
    """The clock's reading at a simulated time in seconds, to the nanosecond."""
    return start_ns + round(time * 1e9)


def clock_s(time: float, start_ns: int = CLOCK_START_NS) -> float:
    """The same in seconds, the float64 that a reader makes of the nanoseconds."""
    return clock_ns(time, start_ns) / 10**9


@dataclass(frozen=True)
class Rig:
    """The sensor on its carrier, as far as a file format has to know it."""

    driver: str  # whose messages the sensor speaks: "velodyne", "ouster", "hesai" or "livox"
    sweep_s: float  # duration of a sweep
    T_world_lidar_at: Callable[[FloatArray], FloatArray]  # true poses (N, 4, 4) at times (N,), simulated seconds
    imu: ImuSamples | None = None  # on simulated time too; None where none is to be recorded


Writer = Callable[[Path, Iterable[SimulatedScan], Rig], None]
"""Makes the folder, which does not exist yet, and writes the scans, holding one of them at a time."""
