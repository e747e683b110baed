"""Where lines enter and leave boxes and cylinders, in torch.

Vectors are (3, ...), the component first: sums over three components written out run over long contiguous rows, and
in full float32 whatever precision matrix products are set to on the device.
"""

import torch
from torch import Tensor

# Below this a component of a unit direction counts as none: what it adds over any range is under rounding.
_TINY = 1e-12


def dot(a: Tensor, b: Tensor) -> Tensor:
    """(...) of vectors (3, ...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def rotate(R: Tensor, v: Tensor) -> Tensor:
    """R v (3, ...) of rotations (3, 3, ...) and vectors (3, ...)."""
    return torch.stack([dot(R[k], v) for k in range(3)])


def meet_box(o: Tensor, d: Tensor, half_sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Ranges (...) at which lines enter and leave boxes, by the method of slabs; a line that misses leaves first.

    Args:
        o, d: (3, ...) origin and direction in the box's frame.
        half_sizes: (3, ...).
    """
    enter, leave = _meet_slab(o[0], d[0], half_sizes[0])
    for k in (1, 2):
        near, far = _meet_slab(o[k], d[k], half_sizes[k])
        enter, leave = torch.maximum(enter, near), torch.minimum(leave, far)
    return enter, leave


def meet_cylinder(o: Tensor, d: Tensor, half_sizes: Tensor) -> tuple[Tensor, Tensor]:
    """The same for cylinders along z with flat ends, of radius `half_sizes[0]` and half length `half_sizes[2]`."""
    across = d[0] ** 2 + d[1] ** 2
    parallel = across < _TINY
    across = torch.where(parallel, torch.ones_like(across), across)
    middle = -(o[0] * d[0] + o[1] * d[1]) / across
    # From the point nearest to the axis: the quadratic's discriminant would be a small difference of large numbers.
    gap2 = (o[0] + middle * d[0]) ** 2 + (o[1] + middle * d[1]) ** 2
    inside2 = torch.where(parallel, half_sizes[0] ** 2 - o[0] ** 2 - o[1] ** 2, half_sizes[0] ** 2 - gap2)
    reach = torch.where(parallel, torch.inf, (inside2.clamp(min=0.0) / across).sqrt())
    reach = torch.where(inside2 > 0.0, reach, -torch.inf)
    near, far = _meet_slab(o[2], d[2], half_sizes[2])
    return torch.maximum(middle - reach, near), torch.minimum(middle + reach, far)


def first_surface(enter: Tensor, leave: Tensor) -> Tensor:
    """Range (...) of the surface that a ray from 0 meets first, from outside or inside; inf where there is none."""
    met = torch.where(enter > 0.0, enter, leave)
    return torch.where((enter <= leave) & (met > 0.0), met, torch.inf)


def _meet_slab(o: Tensor, d: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    slope = 1.0 / torch.where(d.abs() < _TINY, torch.full_like(d, _TINY), d)
    middle, reach = -o * slope, half * slope.abs()
    return middle - reach, middle + reach
