"""Peers of `long_run.py`, each in a process of its own that takes the scans as they come."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Any

import numpy as np
from memory import resident_mb

from lidarslam.compare.peers.estimation import PEERS, Peer, estimate
from lidarslam.compare.peers.interface import Poses, Sweep
from lidarslam.core.errors import LidarSlamError
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory

# Messages to a peer that waits in vain for the next one.
_END = None


class KissIcpEstimator:
    """KISS-ICP's own loop, `register_frame` with its defaults, behind the protocol of peers."""

    def __init__(self) -> None:
        from kiss_icp.config.parser import load_config
        from kiss_icp.kiss_icp import KissICP

        self._kiss: Any = KissICP(load_config(None))
        self._poses: list[Any] = []
        self._instants: list[float] = []

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """It uses no IMU."""

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """The registration, still to be called; see `lidarslam.compare.peers.libraries` on instants."""
        self._instants.append(sweep.end if len(self._instants) >= 2 else sweep.middle)

        def register() -> None:
            self._kiss.register_frame(sweep.scan.points, sweep.scan.time_offsets)
            self._poses.append(self._kiss.last_pose.copy())

        return register

    def finish(self) -> Poses:
        """The poses at the ends of the sweeps."""
        return Poses(np.array(self._instants), np.array(self._poses))


_KISS_ICP = Peer("kiss-icp", "kiss_icp", "kiss-icp", lambda *_: KissIcpEstimator())


class FedPeer:
    """A peer in its process."""

    def __init__(self, context: SpawnContext, name: str, every: int, log: Path) -> None:
        self.name = name
        self._end, other = context.Pipe()
        self._process = context.Process(target=_estimate, args=(other, name, every, log), daemon=True)
        self._process.start()
        other.close()

    def take(self, scan: Scan) -> None:
        """Hand it the next scan; one that died takes no more."""
        try:
            self._end.send(scan)
        except OSError:
            self._end.close()

    def result(self) -> Trajectory | None:
        """Its trajectory; None where it failed, which its log says."""
        try:
            self._end.send(_END)
            trajectory: Trajectory = self._end.recv()
        except (OSError, EOFError):
            return None
        return trajectory


def feed_peers(scans: Iterator[Scan], peers: list[FedPeer]) -> Iterator[Scan]:
    """The same scans, each handed to all peers before; whoever is slow is waited for."""
    for scan in scans:
        for peer in peers:
            peer.take(scan)
        yield scan


def _estimate(source: Connection, name: str, every: int, log: Path) -> None:
    """The peer's process."""
    started = time.process_time()

    def progress(number: int) -> None:
        nonlocal started
        if number % every == 0:
            cpu_ms = 1e3 * (time.process_time() - started) / every
            add_line(log, {"scans": number, "cpu_ms": cpu_ms, "rss_mb": resident_mb()})
            started = time.process_time()

    peer = _KISS_ICP if name == _KISS_ICP.name else PEERS[name]
    try:
        estimated = estimate(peer, iter(source.recv, _END), progress=progress)
    except LidarSlamError as error:
        add_line(log, {"error": str(error)})
        return
    source.send(estimated.trajectory)


def add_line(path: Path, values: Mapping[str, object]) -> None:
    """Append a line of JSON."""
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(values)}\n")
