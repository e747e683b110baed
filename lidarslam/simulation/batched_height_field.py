"""Rays against height fields in torch: a coarse march, and an exact test where a ray may meet the surface."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lidarslam.simulation.batched_fields import WINDOW_CELLS, Fields, surface_at, window_bounds

# Steps that are looked at together: rays that met something nearby are dropped before the next ones.
_STEPS = 16
# How far a ray may pass from a window's heights and is still tested, for rounding.
_SLACK_M = 1e-3
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class _GridRays:
    """N rays in the grid units of one height field each.

    Attributes:
        p, d: (3, N) origin and direction; x and y in cells (per metre of range), z in metres.
        t_in, t_out: (N,) range at which each enters and leaves the space above and below the field.
        stride: (N,) metres of range to a step of the march.
        field: (N,) index of the field among all worlds'.
        number: (N,) which ray it is.
    """

    p: Tensor
    d: Tensor
    t_in: Tensor
    t_out: Tensor
    stride: Tensor
    field: Tensor
    number: Tensor

    def take(self, index: Tensor) -> "_GridRays":
        """Some of them."""
        return _GridRays(
            self.p[:, index],
            self.d[:, index],
            self.t_in[index],
            self.t_out[index],
            self.stride[index],
            self.field[index],
            self.number[index],
        )


def meet_fields(
    fields: Fields, world: Tensor, reference: Tensor, origins: Tensor, directions: Tensor, ranges: Tensor
) -> None:
    """Shorten the ranges of rays that meet a height field nearer, from above or from below.

    Args:
        fields: of W worlds.
        world: (B,) which world each image sees.
        reference: (B, 3) float64 world position that the image's origins are relative to.
        origins, directions: (3, B, N) float32, directions unit, axes of the world.
        ranges: (B, N) how far to look, changed in place.
    """
    flat = ranges.view(-1)
    for f in range(fields.heights.shape[1]):
        rays = _grid_rays(fields, f, world, reference, origins, directions, ranges)
        first = 0
        while len(rays.number):
            _march(fields, rays, first, flat)
            first += _STEPS
            reached = rays.t_in + first * rays.stride
            rays = rays.take(torch.nonzero(reached < torch.minimum(rays.t_out, flat[rays.number])).squeeze(1))


def _grid_rays(
    fields: Fields, f: int, world: Tensor, reference: Tensor, origins: Tensor, directions: Tensor, ranges: Tensor
) -> _GridRays:
    """The rays that come by the f-th field of their world, cut to the box around it."""
    cell = fields.cells_m[world, f, None]
    base = torch.cat([(reference[:, :2] - fields.origins[world, f]) / cell, reference[:, 2:]], dim=1)
    scale = torch.cat([1.0 / cell.expand(-1, 2), torch.ones_like(cell)], dim=1).float()
    # (B, 3) -> (3, B, 1) beside (3, B, N)
    base, scale = (array.float().T[..., None] for array in (base, scale))
    p, d = base + scale * origins, scale * directions
    bounds, last = fields.bounds[world, f], fields.last[world, f]
    lowest = torch.cat([torch.zeros_like(last), bounds[:, :1] - _SLACK_M], dim=1).T[..., None]
    highest = torch.cat([last, bounds[:, 1:] + _SLACK_M], dim=1).T[..., None]
    slope = 1.0 / _nonzero(d)
    one, other = (lowest - p) * slope, (highest - p) * slope
    t_in = torch.minimum(one, other).amax(dim=0).clamp(min=0.0)
    t_out = torch.minimum(torch.maximum(one, other).amin(dim=0), ranges)
    here = (t_in < t_out) & (last[:, :1] > 0.0)
    number = torch.nonzero(here.view(-1)).squeeze(1)
    stride = WINDOW_CELLS / torch.hypot(d[0], d[1]).clamp(min=_TINY)
    field = (world * fields.heights.shape[1] + f)[:, None].expand_as(ranges)
    # (3, B, N) -> (3, B * N), (B, N) -> (B * N)
    every = torch.arange(ranges.numel(), device=ranges.device)
    rays = _GridRays(
        p.flatten(1), d.flatten(1), t_in.view(-1), t_out.view(-1), stride.view(-1), field.reshape(-1), every
    )
    return rays.take(number)


def _march(fields: Fields, rays: _GridRays, first: int, ranges: Tensor) -> None:
    """Look at the steps from `first` on; shorten the ranges (all rays,) in place."""
    t_in, t_out, stride = rays.t_in[:, None], rays.t_out[:, None], rays.stride[:, None]
    step = first + torch.arange(_STEPS, device=ranges.device)
    # Both ends of a step are reckoned alike, so that it begins at the very point where the one before it ends.
    start, end = t_in + step * stride, torch.minimum(t_in + (step + 1) * stride, t_out)  # (n, steps)
    z_start, z_end = (rays.p[2, :, None] + rays.d[2, :, None] * t for t in (start, end))
    x, y = (rays.p[k, :, None] + rays.d[k, :, None] * 0.5 * (start + end) for k in range(2))
    low, high = window_bounds(fields, rays.field[:, None], x, y)
    may_meet = (torch.maximum(z_start, z_end) >= low - _SLACK_M) & (torch.minimum(z_start, z_end) <= high + _SLACK_M)
    ray, step = torch.nonzero(may_meet & (start < t_out), as_tuple=True)
    met = _first_crossing(fields, rays.take(ray), start[ray, step], end[ray, step])
    ranges.scatter_reduce_(0, rays.number[ray], met, "amin")


def _first_crossing(fields: Fields, rays: _GridRays, start: Tensor, end: Tensor) -> Tensor:
    """Range (K,) at which each ray first meets the surface between two ranges (K,), inf where it does not.

    Along the ray the surface is straight between the lines of the grid, x = i, y = j and x - y = k: the height of the
    ray above it, known at those, is linear in between, and its zero exact.
    """
    t = torch.cat(
        [
            _line_crossings(rays.p[0], rays.d[0], start, end, WINDOW_CELLS),
            _line_crossings(rays.p[1], rays.d[1], start, end, WINDOW_CELLS),
            # Along a piece as long as WINDOW_CELLS cells x - y changes by no more than sqrt(2) times that.
            _line_crossings(rays.p[0] - rays.p[1], rays.d[0] - rays.d[1], start, end, int(1.4143 * WINDOW_CELLS) + 1),
        ],
        dim=1,
    )
    t = torch.cat([start[:, None], t.sort(dim=1).values, end[:, None]], dim=1)  # (K, all lines + 2)
    x, y, z = (rays.p[k, :, None] + rays.d[k, :, None] * t for k in range(3))
    above = z - surface_at(fields, rays.field[:, None], x, y)
    one, other = above[:, :-1], above[:, 1:]
    crosses = (one > 0.0) != (other > 0.0)
    share = one / torch.where(crosses, one - other, torch.ones_like(one))
    met = t[:, :-1] + (t[:, 1:] - t[:, :-1]) * share
    return torch.where(crosses, met, torch.inf).amin(dim=1)


def _line_crossings(p: Tensor, d: Tensor, start: Tensor, end: Tensor, count: int) -> Tensor:
    """Ranges (K, count) at which p + d t (K,) passes whole numbers after `start`; those beyond `end` are at `end`."""
    here = p + d * start
    forward = d > 0.0
    first = torch.where(forward, here.floor() + 1.0, here.ceil() - 1.0)
    onward = torch.where(forward, 1.0, -1.0)[:, None] * torch.arange(count, device=p.device)
    t = (first[:, None] + onward - p[:, None]) / _nonzero(d)[:, None]
    return torch.minimum(torch.maximum(t, start[:, None]), end[:, None])


def _nonzero(d: Tensor) -> Tensor:
    return torch.where(d.abs() < _TINY, torch.full_like(d, _TINY), d)
