"""What runs the network, behind which the odometry knows no library: arrays in, a guess with its confidence out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Guess:
    """What a network says of a pair of scans.

    Attributes:
        T_prev_curr: (4, 4) from the middle of the current sweep to the middle of the previous one.
        sigma: (6,) standard deviation along each direction of a change of `T_prev_curr` from the left: rotation in
            radians, then translation in metres.
    """

    T_prev_curr: FloatArray
    sigma: FloatArray

    def is_motion(self) -> bool:
        """Whether a motion follows from it; weights can be finite, and what they make of a scan is not."""
        is_sure = np.isfinite(self.sigma) & (self.sigma > 0.0)
        return bool(np.isfinite(self.T_prev_curr).all() and is_sure.all())


class NetworkRunner(Protocol):
    """Runs a network that says how the sensor moved between two scans."""

    def encode(self, points: Floats, normals: Floats) -> Floats:
        """What is kept of a scan, images (1, 3, H, W), for both pairs it is part of: (1, C, H', W') float32."""

    def compare(self, previous: Floats, current: Floats) -> Guess:
        """The motion between two scans of which `encode` gave these."""
