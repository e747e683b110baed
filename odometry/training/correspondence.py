"""Which point of one cloud belongs to which of another; nothing is differentiated through the choice."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from odometry.images.projection import ImageGrid
from odometry.training.torch_images import place

# Distances held at once by the brute-force search: 256 MiB in float32.
_MAX_DISTANCES = 1 << 26


def nearest(query: Tensor, reference: Tensor, valid: Tensor, workers: int = 1) -> tuple[Tensor, Tensor]:
    """The nearest valid reference point of each query: a k-d tree on the CPU, brute force on other devices.

    Args:
        query: (B, N, 3), metres.
        reference: (B, M, 3), in the same frame.
        valid: (B, M) bool, which reference points may be found.
        workers: threads of the k-d tree's search, -1 for all cores.

    Returns:
        Index (B, N) int64 into M, and distance (B, N) in the dtype of the query. Where there is nothing to find, or
        the query is not finite, the index is 0 and the distance infinite.
    """
    if query.device.type == "cpu":
        return nearest_kd_tree(query, reference, valid, workers)
    return nearest_brute_force(query, reference, valid)


@torch.no_grad()
def nearest_kd_tree(query: Tensor, reference: Tensor, valid: Tensor, workers: int = 1) -> tuple[Tensor, Tensor]:
    """As `nearest`, by one k-d tree for each item of the batch, on the CPU wherever the tensors are."""
    index = torch.zeros(query.shape[:2], dtype=torch.int64)
    distance = torch.full(query.shape[:2], torch.inf, dtype=query.dtype)
    usable = (valid & reference.isfinite().all(-1)).cpu().numpy()
    askable = query.isfinite().all(-1).cpu().numpy()
    for item in range(len(query)):
        (candidates,) = np.nonzero(usable[item])
        (asked,) = np.nonzero(askable[item])
        if not len(candidates) or not len(asked):
            continue
        # Splitting at the middle instead of the median builds faster, which counts as every tree is used once.
        tree = cKDTree(reference[item].cpu().numpy()[candidates], balanced_tree=False, compact_nodes=False)
        lengths, found = tree.query(query[item].cpu().numpy()[asked], workers=workers)
        index[item, asked] = torch.from_numpy(candidates[found])
        distance[item, asked] = torch.from_numpy(lengths).to(distance)
    return index.to(query.device), distance.to(query.device)


@torch.no_grad()
def nearest_brute_force(
    query: Tensor, reference: Tensor, valid: Tensor, max_distances: int = _MAX_DISTANCES
) -> tuple[Tensor, Tensor]:
    """As `nearest`, by all distances, of which no more than `max_distances` (at least M) are held at a time."""
    if not reference.shape[1] or not query.shape[1]:
        return query.new_zeros(query.shape[:2], dtype=torch.int64), query.new_full(query.shape[:2], torch.inf)
    usable = valid & reference.isfinite().all(-1)
    step = max(1, max_distances // reference.shape[1])
    results = [
        _nearest_of_item(query[item], reference[item].masked_fill(~usable[item, :, None], torch.inf), step)
        for item in range(len(query))
    ]
    if not results:
        return query.new_zeros(query.shape[:2], dtype=torch.int64), query.new_zeros(query.shape[:2])
    return torch.stack([index for index, _ in results]), torch.stack([distance for _, distance in results])


@torch.no_grad()
def by_projection(query: Tensor, reference_image: Tensor, grid: ImageGrid) -> tuple[Tensor, Tensor]:
    """The reference point in the pixel that each query lies in.

    Args:
        query: (B, N, 3), metres, in the frame of the image.
        reference_image: (B, 4, H, W) of x, y, z and range, range 0 where there is no point.
        grid: of the image.

    Returns:
        Flat index (B, N) int64 into H * W, and distance (B, N). Outside the image and at empty pixels the distance is
        infinite; outside, the index is 0.

    Raises:
        ValueError: the image is not of the grid's size.
    """
    height, width = reference_image.shape[-2:]
    if (height, width) != (grid.rows, grid.columns):
        raise ValueError(f"the image is {height} x {width}, its grid {grid.rows} x {grid.columns}")
    row, column = ((x + shift).floor() for x, shift in zip(place(query, grid), (0.5, 0.0), strict=True))
    inside = query.isfinite().all(-1) & (row >= 0) & (row < height)
    index = torch.where(inside, row * width + column, 0.0).long()
    pixels = reference_image.flatten(2)  # (B, 4, H, W) -> (B, 4, H * W)
    found = pixels.gather(2, index[:, None].expand(-1, 4, -1)).transpose(1, 2)  # (B, N, 4)
    distance = torch.linalg.vector_norm(query - found[..., :3].to(query), dim=-1)
    return index, torch.where(inside & (found[..., 3] > 0.0), distance, torch.inf)


def _nearest_of_item(query: Tensor, reference: Tensor, step: int) -> tuple[Tensor, Tensor]:
    """Index and distance (N,) for queries (N, 3), `step` of them at a time; unusable references are at infinity."""
    chunks = []
    for start in range(0, len(query), step):
        part = query[start : start + step]
        # Not by |q|^2 + |r|^2 - 2 q.r, which in float32 is centimetres off at 100 m.
        distances = torch.cdist(part, reference.to(part), compute_mode="donot_use_mm_for_euclid_dist")
        chunks.append(distances.nan_to_num(nan=torch.inf, posinf=torch.inf).min(dim=1))
    distance, index = (torch.cat([chunk[i] for chunk in chunks]) for i in range(2))
    return torch.where(distance.isfinite(), index, 0), distance
