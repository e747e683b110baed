"""The sums over pairs of points and planes on a processor: compiled loops, without an array for every step on the way.

The same as `odometry.pair_sums.TorchSums`, in double precision.
"""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from odometry import pair_kernels as kernels
from odometry.alignment_config import AlignmentConfig
from odometry.pair_sums import Tally
from odometry.pairing import Movement
from odometry.sweeps import SweepImages, SweepPairs

Floats = NDArray[np.float32]


class CompiledSums:
    """One pair after the other, for images in the processor's memory; implements `PairSums`."""

    def __init__(self, sweeps: SweepPairs, config: AlignmentConfig) -> None:
        size = len(sweeps.current)
        self._sweeps = [_sweep(sweeps.current, b, config.column_step) for b in range(size)]
        self._planes = [_planes(sweeps.previous, b, config.fill_columns) for b in range(size)]
        self._gates = kernels.Gates(config.gate_m, config.gate_share, config.least_cosine)
        self._fine_m = config.fine_m

    def normal_equations(self, movement: Movement, scale_m: float) -> tuple[FloatArray, FloatArray]:
        """See `PairSums`."""
        H, g = np.empty((len(self._sweeps), 12, 12)), np.empty((len(self._sweeps), 12))
        for b, motion in enumerate(_motions(movement)):
            sweep, planes = self._sweeps[b], self._planes[b]
            kernels.normal_equations(sweep, planes, motion, scale_m, self._gates, H[b], g[b])
        return H, g

    def tally(self, movement: Movement) -> Tally:
        """See `PairSums`."""
        size = len(self._sweeps)
        H, in_view, matched = np.empty((size, 12, 12)), np.empty((size, 3, 3)), np.empty((size, 3, 3))
        sums = np.empty((size, 3))  # points in view, points that lie well, the latter's squared distances
        for b, motion in enumerate(_motions(movement)):
            sweep, planes, written = self._sweeps[b], self._planes[b], (H[b], in_view[b], matched[b])
            sums[b] = kernels.judge(sweep, planes, motion, self._fine_m, self._gates, *written)
        shares = sums[:, :2] / np.maximum([[len(sweep.points)] for sweep in self._sweeps], 1)
        return Tally(H, in_view, matched, shares[:, 0], shares[:, 1], sums[:, 1].astype(np.int64), sums[:, 2])


def _sweep(images: SweepImages, number: int, column_step: int) -> kernels.Sweep:
    """Every so-manieth column's pixels that have a normal."""
    points, normals = (
        part[number, :, :, ::column_step].numpy().reshape(3, -1) for part in (images.points, images.normals)
    )
    offsets = images.offsets[number, :, ::column_step].numpy().reshape(-1)
    chosen = np.flatnonzero(np.einsum("ij,ij->j", normals, normals) > 0.5)
    return kernels.Sweep(
        np.ascontiguousarray(points.take(chosen, axis=1).T),
        np.ascontiguousarray(normals.take(chosen, axis=1).T),
        offsets.take(chosen),
    )


def _planes(images: SweepImages, number: int, fill_columns: int) -> kernels.Planes:
    height, width = images.offsets.shape[1:]
    pixels = np.empty((height * width, 7), dtype=np.float32)
    parts = (images.points, images.normals, images.offsets)
    points, normals, offsets = (np.ascontiguousarray(part[number].numpy()) for part in parts)
    kernels.fill(points, normals, offsets, min(fill_columns, width - 1), pixels)
    return kernels.Planes(
        pixels, height, width, float(images.low[number]), float(images.high[number]), bool(offsets.any())
    )


def _motions(movement: Movement) -> list[kernels.Motion]:
    early, late = movement.velocity - movement.bend, movement.velocity + movement.bend
    return [
        kernels.Motion(*parts) for parts in zip(np.ascontiguousarray(movement.T_prev_curr), early, late, strict=True)
    ]
