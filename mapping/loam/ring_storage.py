"""Rings of a scan that is stored ring after ring, from the turns of its azimuth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved

# Rings have more points than this on average, and there are no more of them.
_FEWEST_POINTS = 50
_MOST_RINGS = 512
# A quarter of a turn of the measure of azimuth below, and a turn.
_HALF_TURN, _TURN = 2.0, 4.0
# A step so near to a whole turn backwards is a wobble at the seam.
_WOBBLE = 0.99
_SUBSAMPLE = 4


@dataclass(frozen=True)
class StorageOrder:
    """How a sensor's sweep is written down: where every ring begins, and which way round it goes.

    Attributes:
        seam: azimuth at which one ring ends and the next begins, radians.
        sense: 1 for counter-clockwise, -1 for clockwise, seen from above.
    """

    seam: float
    sense: int

    @classmethod
    def restored(cls, saved: Saved) -> "StorageOrder":
        """What was saved, which is all of it."""
        return cls(saved.number("seam"), saved.integer("sense"))

    def rings(self, points: FloatArray) -> NDArray[np.int16]:
        """The ring (N,) of each point (N, 3), numbered as stored."""
        steps = np.diff(_azimuth_measure(points, self.seam))
        if self.sense < 0:
            np.negative(steps, out=steps)
        turns = (steps < -_HALF_TURN).astype(np.int16)
        turns -= steps > _WOBBLE * _TURN
        rings = np.zeros(len(points), dtype=np.int16)
        np.cumsum(turns, out=rings[1:])
        return rings


def storage_order(points: FloatArray) -> StorageOrder | None:
    """Where the rings of points (N, 3) begin, if they are stored ring after ring; None if they are not."""
    sampled = points[::_SUBSAMPLE]
    steps = np.diff(np.arctan2(sampled[:, 1], sampled[:, 0])) / (2.0 * np.pi)
    net = float((steps - np.round(steps)).sum())
    most = min(_MOST_RINGS, len(points) / _FEWEST_POINTS)
    if not 1.5 <= abs(net) <= most:
        return None
    sense = 1 if net > 0.0 else -1
    coarse = _best_seam(sampled, sense, np.deg2rad(np.arange(0.0, 360.0, 10.0)))
    return StorageOrder(_best_seam(sampled, sense, coarse + np.deg2rad(np.arange(-9.0, 10.0))), sense)


def _best_seam(points: FloatArray, sense: int, seams: FloatArray) -> float:
    """The seam that leaves the least spread of elevation within rings."""
    elevations = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    spreads = [_spread(elevations, StorageOrder(float(seam), sense).rings(points)) for seam in seams]
    return float(seams[int(np.argmin(spreads))])


def _spread(elevations: FloatArray, rings: NDArray[np.int16]) -> float:
    rings = rings - rings.min()
    counts = np.maximum(np.bincount(rings), 1)
    means = np.bincount(rings, elevations) / counts
    return float(((elevations - means[rings]) ** 2).sum())


def _azimuth_measure(points: FloatArray, seam: float) -> NDArray[np.float32]:
    """(N,) from -2 at the seam through 0 opposite it to 2, growing with the azimuth, without an arc tangent."""
    # Copies of the columns: strided access would be slower than the copy.
    x, y = points[:, 0].astype(np.float32), points[:, 1].astype(np.float32)
    cosine, sine = np.float32(-np.cos(seam)), np.float32(-np.sin(seam))
    along, across = x * cosine + y * sine, y * cosine - x * sine
    size = np.abs(along)
    size += np.abs(across)
    np.maximum(size, np.float32(1e-20), out=size)
    along /= size
    np.subtract(np.float32(1.0), along, out=along)
    return np.copysign(along, across)
