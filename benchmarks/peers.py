"""Peers of `lidarslam compare` on scans in memory, for benchmarks; each run is a process of its own."""

import multiprocessing
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from lidarslam.compare.peers.estimation import estimate
from lidarslam.compare.peers.interface import PeerError
from lidarslam.compare.peers.registry import PEERS
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory

# Those that need no IMU.
NAMES = tuple(name for name, peer in PEERS.items() if not peer.needs_imu)


def run_peer(name: str, scans: Iterable[Scan]) -> Trajectory:
    """The trajectory of a peer at the scans' stamps.

    Raises:
        PeerError: it is not installed, its process ended early, or it has no usable poses.
    """
    PEERS[name].require(lambda: False)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(_estimate, name, list(scans)).result()
        except BrokenProcessPool:
            raise PeerError("its process ended before the last scan") from None


def _estimate(name: str, scans: Sequence[Scan]) -> Trajectory:
    return estimate(PEERS[name], scans).trajectory
