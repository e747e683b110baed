"""A recording through a peer: its trajectory at the scans' stamps, and the time of each scan."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.compare.peers.interface import Estimator, PeerError, Poses, Sweep
from lidarslam.compare.peers.registry import Peer
from lidarslam.core.geometry import FloatArray, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory

# Fewer points do not fix six degrees of freedom, and some libraries abort on a handful.
_MIN_POINTS = 10
# Poses are extrapolated to stamps so far outside their instants: the most of a sweep's duration.
_EXTRAPOLATION_S = 0.25
# Poses farther apart than this, and than so many of their usual steps, are not interpolated.
_LONGEST_GAP_S, _LONGEST_GAP_STEPS = 1.0, 5.0


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a peer makes of a recording."""

    trajectory: Trajectory  # at the stamps of the scans that its poses cover
    register_ms: dict[float, float]  # stamp -> wall time of the registration of that scan


def estimate(
    peer: Peer,
    scans: Iterable[Scan],
    imu: ImuSamples | None = None,
    progress: Callable[[int], None] = lambda _: None,
    range_m: float | None = None,
) -> Estimate:
    """Register all scans.

    Args:
        peer: which one.
        scans: in the order of time; those without times are taken for motion compensated, and then all have to be.
        imu: for the peers that need it.
        progress: called after every scan with its number from 1.
        range_m: maximum range by the size of the scene, for the peers with voxels; None: their defaults.

    Raises:
        PeerError: it cannot run, or has no usable poses.
    """
    peer.require(lambda: imu is not None)
    samples = imu if peer.needs_imu else None
    estimator: Estimator | None = None
    stamps: list[float] = []
    register_ms: dict[float, float] = {}
    taken = 0
    for scan in scans:
        stamps.append(scan.stamp)
        if len(scan) >= _MIN_POINTS:
            sweep = Sweep.of(scan)
            estimator = estimator or peer.make(sweep, samples, range_m)
            register = estimator.load(sweep)
            started = time.perf_counter()
            taken = _take_imu(estimator, samples, taken, sweep.end)
            register()
            register_ms[scan.stamp] = 1e3 * (time.perf_counter() - started)
        progress(len(stamps))
    if estimator is None:
        raise PeerError(f"none of the {len(stamps)} scans has {_MIN_POINTS} points")
    return Estimate(_at_stamps(estimator.finish(), np.array(stamps)), register_ms)


def _take_imu(estimator: Estimator, samples: ImuSamples | None, taken: int, until: float) -> int:
    """Hand on the samples up to an instant, from number `taken` on; the number of the next one."""
    if samples is None:
        return 0
    end = int(np.searchsorted(samples.stamps, until, side="right"))
    for number in range(taken, end):
        estimator.add_imu(samples, number)
    return max(taken, end)


def _at_stamps(poses: Poses, stamps: FloatArray) -> Trajectory:
    """The trajectory at those stamps that the poses cover.

    Raises:
        PeerError: there are fewer than two poses, or they are no rigid motions.
    """
    instants, T_world_lidar = poses.instants, poses.T_world_lidar
    if not np.isfinite(T_world_lidar).all():
        raise PeerError(f"some of its {len(instants)} poses are not finite")
    T_world_lidar = orthonormalize(T_world_lidar)
    if len(instants) < 2:
        raise PeerError(f"has {len(instants)} poses for {len(stamps)} scans, and two or more are needed")
    covered = stamps[is_covered(instants, stamps)]
    return Trajectory(covered, Trajectory(instants, T_world_lidar).at(covered, _EXTRAPOLATION_S))


def is_covered(instants: FloatArray, stamps: FloatArray) -> NDArray[np.bool_]:
    """Which stamps (N,) have a pose: none within a gap between instants (M,), or far outside them."""
    steps = np.diff(instants)
    left = np.clip(np.searchsorted(instants, stamps, side="right") - 1, 0, len(steps) - 1)
    outside_s = np.maximum(instants[0] - stamps, stamps - instants[-1])
    longest_s = max(_LONGEST_GAP_S, _LONGEST_GAP_STEPS * float(np.median(steps)))
    return np.asarray((steps[left] <= longest_s) & (outside_s <= _EXTRAPOLATION_S))
