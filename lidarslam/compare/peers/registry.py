"""The peers by name; their libraries are loaded on use."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import cast

from lidarslam.compare.peers.evalio_pipelines import PIPELINES, EvalioEstimator
from lidarslam.compare.peers.interface import Estimator, PeerError, Sweep
from lidarslam.compare.peers.libraries import KissSlamEstimator, RkoLioEstimator, SmallGicpEstimator
from lidarslam.core.imu import ImuSamples
from lidarslam.core.plugins import PlugPoint

EXTRA = "pip install 'lidarslam[peers]'"

Make = Callable[[Sweep, ImuSamples | None, float | None], Estimator]
"""From the first sweep with points, the IMU, and the maximum range by the size of the scene; None: its defaults."""


@dataclass(frozen=True)
class Peer:
    """Another program on the same scans."""

    name: str  # in `--methods`
    library: str  # the module that it needs
    package: str  # that holds it
    make: Make
    needs_imu: bool = False
    has_voxels: bool = True  # whether it has settings that follow the size of the scene

    @property
    def is_installed(self) -> bool:
        """Whether its library is there."""
        return importlib.util.find_spec(self.library) is not None

    @property
    def version(self) -> str:
        """Package and version, such as `evalio 0.6.1`."""
        return f"{self.package} {version(self.package)}"

    def require(self, has_imu: Callable[[], bool]) -> None:
        """Refuse where it cannot run."""
        if not self.is_installed:
            extra = EXTRA if self.name in PEERS else f"pip install {self.package}"
            raise PeerError(f"runs with {self.package}, which is not installed: {extra}")
        if self.needs_imu and not has_imu():
            raise PeerError("needs an IMU, and the recording has none")


_ALL = (
    *(
        Peer(name, "evalio", "evalio", partial(EvalioEstimator, one), one.needs_imu, bool(one.voxels_m))
        for name, one in PIPELINES.items()
    ),
    Peer("kiss-slam", "kiss_slam", "kiss-slam", KissSlamEstimator),
    Peer("small-gicp", "small_gicp", "small_gicp", SmallGicpEstimator),
    Peer("rko-lio", "rko_lio", "rko_lio", RkoLioEstimator, needs_imu=True),
)
PEERS = {peer.name: peer for peer in _ALL}
ALL_PEERS = PlugPoint("peer", tuple(PEERS))


def peer_named(name: str) -> Peer:
    """The peer of a name in `ALL_PEERS`."""
    return PEERS.get(name) or cast(Peer, ALL_PEERS.load(name, Peer))
