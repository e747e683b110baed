"""A recording through a peer: its trajectory at the scans' stamps, and the time of each scan."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from lidarslam.compare.peers.interface import Estimator, PeerError, Poses, Sweep
from lidarslam.compare.peers.registry import Peer
from lidarslam.core.geometry import FloatArray, is_rigid, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory

# Fewer points do not fix six degrees of freedom, and some libraries abort on a handful.
_MIN_POINTS = 10
# Poses are extrapolated to stamps so far outside their instants: the most of a sweep's duration.
_EXTRAPOLATION_S = 0.25


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a peer makes of a recording."""

    trajectory: Trajectory  # at the stamps of the scans that its poses cover
    register_ms: dict[float, float]  # stamp -> wall time of the registration of that scan
    uncovered: int  # number of scans before its first pose or after its last


def estimate(
    peer: Peer, scans: Iterable[Scan], imu: ImuSamples | None = None, progress: Callable[[int], None] = lambda _: None
) -> Estimate:
    """Register all scans.

    Args:
        peer: which one.
        scans: in the order of time; those without times are taken for motion compensated, and then all have to be.
        imu: for the peers that need it.
        progress: called after every scan with its number from 1.

    Raises:
        PeerError: it cannot run, or has no usable poses.
    """
    peer.require(imu is not None)
    imu = imu if peer.needs_imu else None
    estimator: Estimator | None = None
    stamps, register_ms, taken, count = [], {}, 0, 0
    for count, scan in enumerate(scans, start=1):
        stamps.append(scan.stamp)
        if len(scan) >= _MIN_POINTS:
            sweep = Sweep.of(count - 1, scan)
            estimator = estimator or peer.make(sweep, imu)
            started, taken = _take_imu(estimator, imu, taken, sweep.end)
            register = estimator.load(sweep)
            begun = time.perf_counter()
            register()
            register_ms[scan.stamp] = 1e3 * (time.perf_counter() - begun + started)
        progress(count)
    if estimator is None:
        raise PeerError(f"{peer.name}: none of the {count} scans has {_MIN_POINTS} points")
    return Estimate(*_at_stamps(peer.name, estimator.finish(), np.array(stamps)), register_ms, 0)
