"""The sums over pairs of points and planes on a processor: compiled loops, without an array for every step on the way.

The same as `odometry.pair_sums.TorchSums`, in double precision.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidarslam.core.geometry import FloatArray
from odometry import image_kernels as kernels
from odometry.alignment_config import AlignmentConfig
from odometry.pair_sums import Tally
from odometry.pairing import Movement
from odometry.sweeps import SweepImages, SweepPairs

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _Source:
    """The points (N, 3) of a sweep that have normals (N, 3), and their seconds (N,) from its middle."""

    points: Floats
    normals: Floats
    offsets: Floats


class CompiledSums:
    """One pair after the other, for images in the processor's memory; implements `PairSums`."""

    def __init__(self, sweeps: SweepPairs, config: AlignmentConfig) -> None:
        size = len(sweeps.current)
        self._sources = [_source(sweeps.current, b, config.column_step) for b in range(size)]
        self._planes = [_planes(sweeps.previous, b, config.fill_columns) for b in range(size)]
        self._gates = kernels.Gates(config.gate_m, config.gate_share, config.least_cosine)
        self._fine_m = config.fine_m

    def normal_equations(self, movement: Movement, scale_m: float) -> tuple[Tensor, Tensor]:
        """See `PairSums`."""
        H, g = np.empty((len(self._sources), 12, 12)), np.empty((len(self._sources), 12))
        for b, (T, early, late) in enumerate(_motions(movement)):
            source = self._sources[b]
            kernels.normal_equations(
                source.points, source.normals, source.offsets, self._planes[b], T, early, late, scale_m, self._gates,
                H[b], g[b],
            )  # fmt: skip
        return torch.from_numpy(H), torch.from_numpy(g)

    def tally(self, movement: Movement) -> Tally:
        """See `PairSums`."""
        size = len(self._sources)
        H, in_view, matched = np.empty((size, 12, 12)), np.empty((size, 3, 3)), np.empty((size, 3, 3))
        sums = np.empty((size, 3))  # points in view, points that lie well, the latter's squared distances
        for b, (T, early, late) in enumerate(_motions(movement)):
            source = self._sources[b]
            sums[b] = kernels.judge(
                source.points, source.normals, source.offsets, self._planes[b], T, early, late, self._fine_m,
                self._gates, H[b], in_view[b], matched[b],
            )  # fmt: skip
        dtype = movement.T_prev_curr.dtype
        shares = sums[:, :2] / np.maximum([[len(source.points)] for source in self._sources], 1)
        return Tally(
            H=torch.from_numpy(H),
            in_view=torch.from_numpy(in_view).to(dtype),
            matched=torch.from_numpy(matched).to(dtype),
            share_in_view=torch.from_numpy(shares[:, 0]).to(dtype),
            share=torch.from_numpy(shares[:, 1]).to(dtype),
            count=torch.from_numpy(sums[:, 1]).long(),
            squares=torch.from_numpy(sums[:, 2]).to(dtype),
        )


def _source(images: SweepImages, number: int, column_step: int) -> _Source:
    """Every so-manieth column's pixels that have a normal."""
    points, normals = (
        part[number, :, :, ::column_step].numpy().reshape(3, -1) for part in (images.points, images.normals)
    )
    offsets = images.offsets[number, :, ::column_step].numpy().reshape(-1)
    chosen = np.flatnonzero(np.einsum("ij,ij->j", normals, normals) > 0.5)
    return _Source(
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
    return kernels.Planes(pixels, height, width, float(images.low[number]), float(images.high[number]))


def _motions(movement: Movement) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """T_prev_curr (4, 4), and the velocities (6,) in the middles of the previous and of the current sweep."""
    T = movement.T_prev_curr.double().numpy()
    velocity, bend = movement.velocity.double().numpy(), movement.bend.double().numpy()
    return list(zip(np.ascontiguousarray(T), velocity - bend, velocity + bend, strict=True))
