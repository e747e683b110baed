"""The loops over pixels and their neighbourhoods behind `odometry.images.normals`, compiled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled

Floats = NDArray[np.float32]

# All in single precision, of which a processor does twice as many at once.
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0))
_TINY = np.float32(1e-30)
# A neighbourhood that is narrower than this share of its range is narrower than the rounding of its coordinates.
_NARROWEST = np.float32(1e-5)
# Range noise spreads the points of a single ring over a plane that holds the rays themselves. Such a plane, 2.3
# degrees or less from the ray, says nothing of the surface, and which of its sides faces the sensor is chance.
_MOST_GRAZING = np.float32(0.04)
# Pixels that are worked on together, so that the processor takes several at once.
BLOCK = 256
# From one quantity of a block to the next. Were it a power of two, the processor would take a store for what the next
# load needs, and wait.
STRIDE = BLOCK + 16
# Part of a row's pixels from which on all are worked on.
MANY = 0.4


class Neighbourhood(NamedTuple):
    """Which neighbours count, and which neighbourhoods are planes; see `NormalConfig`."""

    rows: int
    columns: int
    gate_m: float
    most_apart_m: float
    min_neighbours: int
    max_flatness: float
    min_spread: float


@compiled
def pad(image: Floats, rows: int, columns: int, padded: Floats) -> None:
    """Write an image (4, H, W) with rows above and below, and columns that go on round; empty is infinitely far."""
    height, width = image.shape[1:]
    padded[:3, :rows], padded[3, :rows] = 0.0, np.inf
    padded[:3, rows + height :], padded[3, rows + height :] = 0.0, np.inf
    for channel in range(4):
        for i in range(height):
            row = padded[channel, rows + i]
            row[columns : columns + width] = image[channel, i]
            row[:columns] = image[channel, i, width - columns :]
            row[columns + width :] = image[channel, i, :columns]
    for i in range(height):
        ranges = padded[3, rows + i]
        for j in range(len(ranges)):
            ranges[j] = ranges[j] if ranges[j] > 0.0 else np.inf


@compiled
def planes(padded: Floats, margin: int, around: Neighbourhood, normals: Floats) -> None:
    """Write unit normals (3, H, W) that face the sensor, of pixels that have none yet and lie on a plane.

    Args:
        padded: (4, H + 2 rows, W + 2 margin) of x, y, z and range, with what lies beyond the image's borders;
            infinitely far where empty.
        margin: columns to either side, no fewer than those of the neighbourhood.
        around: the neighbourhood.
        normals: written.
    """
    height, width = normals.shape[1:]
    wanted, neighbours = np.empty(width, dtype=np.int64), np.empty((4, BLOCK), dtype=np.float32)
    work, found = np.empty(15 * STRIDE, dtype=np.float32), np.empty(3 * STRIDE, dtype=np.float32)
    for i in range(height):
        count, ranges = 0, padded[3, i + around.rows]
        for j in range(width):
            if ranges[margin + j] < np.inf and not (normals[0, i, j] or normals[1, i, j] or normals[2, i, j]):
                wanted[count] = margin + j
                count += 1
        if count > MANY * width:  # one beside the other they are read faster than if the others were left out
            for j in range(width):
                wanted[j] = margin + j
            count = width
        for begin in range(0, count, BLOCK):
            block = wanted[begin : min(begin + BLOCK, count)]
            size = len(block)
            _scatter(padded, i, block, around, neighbours, work)
            _fit(size, work, around, found)
            for k in range(size):
                j = block[k] - margin
                if not (normals[0, i, j] or normals[1, i, j] or normals[2, i, j]):
                    normals[0, i, j], normals[1, i, j] = found[k], found[STRIDE + k]
                    normals[2, i, j] = found[2 * STRIDE + k]


@compiled
def _scatter(
    padded: Floats, i: int, block: NDArray[np.int64], around: Neighbourhood, neighbours: Floats, work: Floats
) -> None:
    """Write what the neighbours of the pixels of a block, all of row i, are like, about the pixel itself.

    Coordinates of tens of metres would leave no digits to float32. Each neighbour is added for the whole block, so that
    the processor takes several pixels at once.

    Args:
        padded, around: as for `planes`.
        i: the row.
        block: (K,) columns of the padded image.
        neighbours: (4, 256), room.
        work: (15 * STRIDE,), written: x, y, z and range of the pixels; of their neighbours the number, the squared
            distance of the nearest, and sums of x, y, z, xx, yy, zz, xy, yz, xz.
    """
    size = len(block)
    together = block[size - 1] - block[0] == size - 1
    work[:] = 0.0
    work[5 * STRIDE : 6 * STRIDE] = np.inf
    for channel in range(4):
        row = padded[channel, i + around.rows]
        for k in range(size):
            work[channel * STRIDE + k] = row[block[k]]
    gate_m = np.float32(around.gate_m)
    near_x, near_y, near_z, near_ranges = neighbours[0], neighbours[1], neighbours[2], neighbours[3]
    for down in range(2 * around.rows + 1):
        # One by one: what is indexed by a slice in the middle is taken as not contiguous, and is not done at once.
        x, y, z, ranges = padded[0, i + down], padded[1, i + down], padded[2, i + down], padded[3, i + down]
        for right in range(-around.columns, around.columns + 1):
            least = np.float32(np.inf if down == around.rows and right == 0 else 0.0)
            if together:
                begin, end = block[0] + right, block[0] + right + size
                _add(size, gate_m, least, x[begin:end], y[begin:end], z[begin:end], ranges[begin:end], work)
            else:
                for k in range(size):
                    j = block[k] + right
                    near_x[k], near_y[k], near_z[k], near_ranges[k] = x[j], y[j], z[j], ranges[j]
                _add(size, gate_m, least, near_x, near_y, near_z, near_ranges, work)


@compiled
def _add(
    size: int, gate_m: np.float32, least: np.float32, x: Floats, y: Floats, z: Floats, ranges: Floats, work: Floats
) -> None:
    """Add a neighbour of each pixel to what `_scatter` writes; `least` is added to its distance."""
    zero, one, far = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
    for k in range(size):
        near = abs(ranges[k] - work[3 * STRIDE + k]) <= gate_m
        mask = one if near else zero
        dx, dy, dz = (x[k] - work[k]) * mask, (y[k] - work[STRIDE + k]) * mask, (z[k] - work[2 * STRIDE + k]) * mask
        xx, yy, zz = dx * dx, dy * dy, dz * dz
        apart = xx + yy + zz + least
        apart = apart if near else far
        work[4 * STRIDE + k] += mask
        work[5 * STRIDE + k] = apart if apart < work[5 * STRIDE + k] else work[5 * STRIDE + k]
        work[6 * STRIDE + k] += dx
        work[7 * STRIDE + k] += dy
        work[8 * STRIDE + k] += dz
        work[9 * STRIDE + k] += xx
        work[10 * STRIDE + k] += yy
        work[11 * STRIDE + k] += zz
        work[12 * STRIDE + k] += dx * dy
        work[13 * STRIDE + k] += dy * dz
        work[14 * STRIDE + k] += dx * dz


@compiled
def _fit(size: int, work: Floats, around: Neighbourhood, found: Floats) -> None:
    """Write the normals (3 * STRIDE,) of a block of pixels that have these neighbours; zero if they lie on no plane.

    Without branches, so that the processor takes several at once. The smallest eigenvalue is the root of the
    characteristic polynomial that Newton's method finds from below; of a plane, in few steps. Where it is not small the
    answer is too small, and still too large for a plane.
    """
    least_count, most_apart_m2 = np.float32(around.min_neighbours), np.float32(around.most_apart_m**2)
    max_flatness, min_spread = np.float32(around.max_flatness), np.float32(around.min_spread)
    for k in range(size):
        x, y, z, distance = work[k], work[STRIDE + k], work[2 * STRIDE + k], work[3 * STRIDE + k]
        count, sx, sy, sz = work[4 * STRIDE + k], work[6 * STRIDE + k], work[7 * STRIDE + k], work[8 * STRIDE + k]
        each = _ONE / (count if count > _ONE else _ONE)
        mx, my, mz = sx * each, sy * each, sz * each
        xx, yy, zz = work[9 * STRIDE + k] - sx * mx, work[10 * STRIDE + k] - sy * my, work[11 * STRIDE + k] - sz * mz
        xy, yz, xz = work[12 * STRIDE + k] - sx * my, work[13 * STRIDE + k] - sy * mz, work[14 * STRIDE + k] - sx * mz
        # Rounding may leave next to nothing, or less, of the scatter of points that are all but one.
        size_m2 = xx + yy + zz
        is_plane = count >= least_count and work[5 * STRIDE + k] <= most_apart_m2 and size_m2 > _TINY
        scale = _ONE / (size_m2 if size_m2 > _TINY else _ONE)
        xx, yy, zz, xy, yz, xz = xx * scale, yy * scale, zz * scale, xy * scale, yz * scale, xz * scale
        # The characteristic polynomial is s^3 - s^2 + pairs s - determinant.
        pairs = (xx * yy - xy * xy) + (yy * zz - yz * yz) + (zz * xx - xz * xz)
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        s = determinant / (pairs if pairs > _TINY else _ONE)
        s = s - (((s - _ONE) * s + pairs) * s - determinant) / _steepness(s, pairs)
        s = s - (((s - _ONE) * s + pairs) * s - determinant) / _steepness(s, pairs)
        s = s - (((s - _ONE) * s + pairs) * s - determinant) / _steepness(s, pairs)
        # The other two have the sum 1 - s and this product.
        product, half = pairs - s * (_ONE - s), _HALF * (_ONE - s)
        left = half * half - product
        largest = half + np.sqrt(left if left > _ZERO else _ZERO)
        middle = product / (largest if largest > _TINY else _ONE)
        narrowest = _NARROWEST * distance
        is_plane = is_plane and s <= max_flatness * middle and middle >= min_spread * largest
        is_plane = is_plane and middle * size_m2 > count * narrowest * narrowest
        # The rows of A - s I are at right angles to the normal: the longest of their cross products is along it.
        a, b, c = xx - s, yy - s, zz - s
        first, second, third = b * c - yz * yz, a * c - xz * xz, a * b - xy * xy
        off_xy, off_yz, off_xz = xz * yz - xy * c, xy * xz - a * yz, xy * yz - xz * b
        by_first = first >= second and first >= third
        by_second = second >= third
        u = first if by_first else (off_xy if by_second else off_xz)
        v = off_xy if by_first else (second if by_second else off_yz)
        w = off_xz if by_first else (off_yz if by_second else third)
        length = np.sqrt(u * u + v * v + w * w)
        each = _ONE / (length if length > _TINY else _ONE)
        away = (u * x + v * y + w * z) * each
        is_plane = is_plane and abs(away) >= _MOST_GRAZING * distance
        each = -each if away > _ZERO else each
        found[k] = u * each if is_plane else _ZERO
        found[STRIDE + k] = v * each if is_plane else _ZERO
        found[2 * STRIDE + k] = w * each if is_plane else _ZERO


@compiled
def _steepness(s: np.float32, pairs: np.float32) -> np.float32:
    """The derivative of the characteristic polynomial, which is positive below the smallest eigenvalue."""
    steepness = (_THREE * s - _TWO) * s + pairs
    return steepness if steepness > _TINY else _ONE
