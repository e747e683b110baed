"""Worlds as tensors on a device, several padded into one batch, for the batched caster."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.batched_fields import Fields
from lidarslam.simulation.world import Boxes, Cylinders, Mover, World


@dataclass(frozen=True, eq=False)
class Solids:
    """Boxes or cylinders of W worlds, P each; a cylinder is given as the box around it, its axis along z.

    Attributes:
        centres: (W, P, 3) float64, in the world.
        R_world_solid: (W, P, 3, 3) float32.
        half_sizes: (W, P, 3) float32; negative where there is no solid.
        radii: (W, P) float32 of the sphere around each; -inf where there is no solid.
    """

    centres: Tensor
    R_world_solid: Tensor
    half_sizes: Tensor
    radii: Tensor


@dataclass(frozen=True, eq=False)
class Movers:
    """What moves in W worlds: M movers each, of Q boxes each, on closed polylines of L legs.

    Attributes:
        R_mover_box, centres, half_sizes: (W, M, Q, 3, 3), (W, M, Q, 3) and (W, M, Q, 3) float32, in the mover's frame;
            half sizes are negative where there is no box.
        radii: (W, M) float32 of the sphere around the mover's origin that holds its boxes; -inf where there is none.
        corners, steps: (W, M, L, 3) float64 start of each leg and the way to its end.
        ends: (W, M, L) float64 metres along the polyline at the end of each leg.
        speeds_mps, starts_m: (W, M) float64, see `Mover`.
    """

    R_mover_box: Tensor
    centres: Tensor
    half_sizes: Tensor
    radii: Tensor
    corners: Tensor
    steps: Tensor
    ends: Tensor
    speeds_mps: Tensor
    starts_m: Tensor


@dataclass(frozen=True, eq=False)
class BatchedWorld:
    """W worlds on one device; worlds with fewer primitives than others are padded with ones that no ray meets.

    Attributes:
        boxes, cylinders, fields, movers: see there.
    """

    boxes: Solids
    cylinders: Solids
    fields: Fields
    movers: Movers

    @classmethod
    def from_world(cls, world: World, device: torch.device | str = "cpu") -> "BatchedWorld":
        """One world."""
        return cls.from_worlds([world], device)

    @classmethod
    def from_worlds(cls, worlds: Sequence[World], device: torch.device | str = "cpu") -> "BatchedWorld":
        """Several worlds, in their order.

        Raises:
            ValueError: there is none.
        """
        if not worlds:
            raise ValueError("BatchedWorld.from_worlds needs at least one world")
        return cls(
            _solids([world.boxes for world in worlds], device),
            _solids([_boxes_around(world.cylinders) for world in worlds], device, round_section=True),
            Fields.from_worlds([world.height_fields for world in worlds], device),
            _movers([world.movers for world in worlds], device),
        )

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.boxes.centres.device

    def __len__(self) -> int:
        return len(self.boxes.centres)


def _padded(arrays: Sequence[NDArray[np.generic]], fill: float | FloatArray) -> FloatArray:
    """(W, P, ...) float64 from W arrays (P_w, ...), the missing rows filled."""
    shape = (len(arrays), max(len(array) for array in arrays), *arrays[0].shape[1:])
    out = np.empty(shape)
    out[...] = fill
    for row, array in zip(out, arrays, strict=True):
        row[: len(array)] = array
    return out


def _on_device(array: FloatArray, device: torch.device | str, dtype: torch.dtype = torch.float32) -> Tensor:
    """A copy of an array as a tensor."""
    return torch.tensor(array, dtype=dtype, device=device)


def _boxes_around(cylinders: Cylinders) -> Boxes:
    axis = cylinders.ends - cylinders.starts
    length = np.linalg.norm(axis, axis=1)
    z = axis / length[:, None]
    x = np.cross(z, np.eye(3)[np.abs(z).argmin(axis=1)]) if len(z) else z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    half_sizes = np.stack([cylinders.radii, cylinders.radii, 0.5 * length], axis=-1)
    return Boxes(0.5 * (cylinders.starts + cylinders.ends), half_sizes, np.stack([x, np.cross(z, x), z], axis=-1))


def _solids(worlds: Sequence[Boxes], device: torch.device | str, round_section: bool = False) -> Solids:
    radii = [
        np.hypot(b.half_sizes[:, 0], b.half_sizes[:, 2]) if round_section else np.linalg.norm(b.half_sizes, axis=1)
        for b in worlds
    ]
    return Solids(
        _on_device(_padded([b.centres for b in worlds], 0.0), device, torch.float64),
        _on_device(_padded([b.R_world_box for b in worlds], np.eye(3)), device),
        _on_device(_padded([b.half_sizes for b in worlds], -1.0), device),
        _on_device(_padded(radii, -np.inf), device),
    )


def _movers(worlds: Sequence[Sequence[Mover]], device: torch.device | str) -> Movers:
    boxes = [[mover.boxes for mover in movers] for movers in worlds]
    legs = [[_legs(mover) for mover in movers] for movers in worlds]

    def rows(parts: list[list[FloatArray]], fill: float | FloatArray, row: tuple[int, ...]) -> FloatArray:
        longest = max([1, *(len(part) for world in parts for part in world)])
        filled = [[np.broadcast_to(fill, (longest, *row)), *world] for world in parts]
        # The first, which is only there to have the length, is dropped.
        return _padded([_padded(world, fill)[1:] for world in filled], fill)

    def figures(of_world: list[list[float]], fill: float, dtype: torch.dtype) -> Tensor:
        return _on_device(_padded([np.array(world) for world in of_world], fill), device, dtype)

    return Movers(
        _on_device(rows([[b.R_world_box for b in world] for world in boxes], np.eye(3), (3, 3)), device),
        _on_device(rows([[b.centres for b in world] for world in boxes], 0.0, (3,)), device),
        _on_device(rows([[b.half_sizes for b in world] for world in boxes], -1.0, (3,)), device),
        figures([[_reach(b) for b in world] for world in boxes], -np.inf, torch.float32),
        _on_device(rows([[leg[:, :3] for leg in world] for world in legs], 0.0, (3,)), device, torch.float64),
        _on_device(rows([[leg[:, 3:6] for leg in world] for world in legs], 0.0, (3,)), device, torch.float64),
        _on_device(rows([[leg[:, 6] for leg in world] for world in legs], np.inf, ()), device, torch.float64),
        figures([[m.speed_mps for m in movers] for movers in worlds], 0.0, torch.float64),
        figures([[m.start_m for m in movers] for movers in worlds], 0.0, torch.float64),
    )


def _reach(boxes: Boxes) -> float:
    if not len(boxes):
        return -np.inf
    return float((np.linalg.norm(boxes.centres, axis=1) + np.linalg.norm(boxes.half_sizes, axis=1)).max())


def _legs(mover: Mover) -> FloatArray:
    """(L, 7): corner, step to the next one, metres along the polyline there; legs of no length are left out."""
    steps = np.roll(mover.waypoints, -1, axis=0) - mover.waypoints
    lengths = np.linalg.norm(steps, axis=1)
    if lengths.sum() <= 0.0:
        return np.concatenate([mover.waypoints[0], np.zeros(3), np.ones(1)])[None]
    legs = np.column_stack([mover.waypoints, steps, np.cumsum(lengths)])
    return np.asarray(legs[lengths > 0.0])
