"""Nearest-neighbour correspondences; nothing is differentiated through the choice."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

# Distances held at once by the brute-force search: 256 MiB in float32.
_MAX_DISTANCES = 1 << 26


@torch.no_grad()
def nearest(query: Tensor, reference: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest valid reference point of each query: by a k-d tree on the CPU, by all distances on other devices.

    Args:
        query: (B, N, 3), metres.
        reference: (B, M, 3), finite, in the same frame.
        valid: (B, M) bool, which reference points may be found.

    Returns:
        Index (B, N) int64 into M, and distance (B, N) in the dtype of the query. Without a valid reference, or where
        the query is not finite, the index is 0 and the distance infinite.
    """
    index = torch.zeros(query.shape[:2], dtype=torch.int64, device=query.device)
    distance = query.new_full(query.shape[:2], torch.inf)
    search = _by_kd_tree if query.device.type == "cpu" else _by_all_distances
    for item in range(len(query)):
        (candidates,), (asked,) = (x.nonzero(as_tuple=True) for x in (valid[item], query[item].isfinite().all(-1)))
        if len(candidates) and len(asked):
            found, lengths = search(query[item, asked], reference[item, candidates])
            index[item, asked], distance[item, asked] = candidates[found], lengths.to(distance)
    return index, distance


def _by_kd_tree(query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """Index and distance (N,) for queries (N, 3)."""
    # Splitting at the middle instead of the median builds faster, which counts as every tree is used once.
    tree = cKDTree(reference.numpy(), balanced_tree=False, compact_nodes=False)
    lengths, found = tree.query(query.numpy())
    return torch.from_numpy(found), torch.from_numpy(lengths)


def _by_all_distances(query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """Likewise, of which no more than `_MAX_DISTANCES` are held at a time."""
    # Not by |q|^2 + |r|^2 - 2 q.r, which in float32 is centimetres off at 100 m.
    chunks = [
        torch.cdist(part, reference, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
        for part in torch.split(query, max(1, _MAX_DISTANCES // len(reference)))
    ]
    return torch.cat([chunk.indices for chunk in chunks]), torch.cat([chunk.values for chunk in chunks])
