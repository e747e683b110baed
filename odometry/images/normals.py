"""Surface normals of range images: a plane fitted to the neighbourhood of each pixel.

A principal component analysis of the points around each pixel whose ranges are close to its own, as in DeLORA (Nubert
et al., ICRA 2021). Pixels that find no plane try again with a wider patch and gate.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.odometry.images.projection import Floats

# All in single precision, for twice as many numbers per vector instruction.
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0))
_TINY, _FAR = np.float32(1e-30), np.float32(np.inf)
# A patch narrower than this share of its range is narrower than the rounding of its coordinates.
_NARROWEST = np.float32(1e-5)
# Range noise spreads the points of a single ring over a plane that holds the rays themselves. Such a plane, 2.3
# degrees or less from the ray, is no surface, and the side that faces the sensor is random.
_MOST_GRAZING = np.float32(0.04)
# Pixels of a row that are fitted together, in vectorised loops.
_BLOCK = 240
# From one quantity of a block to the next. Were it a power of two, loads would wait for stores to other quantities.
_STRIDE = _BLOCK + 32
# Neighbours that are added together, in registers.
_AT_ONCE = 3


class Patch(NamedTuple):
    """The neighbourhood of a pixel, and when its points are a plane."""

    # rows, columns: how far it reaches up and down, and to the left and to the right
    rows: int
    columns: int
    gate_m: float  # neighbours whose range differs by more are left out
    nearest_m: float = 1.0  # the nearest neighbour must be as close as this
    min_neighbours: int = 6  # points that are needed, the pixel's own included
    max_flatness: float = 0.1  # smallest eigenvalue of the scatter over the middle one, at most
    min_spread: float = 0.02  # middle eigenvalue over the largest one, at least
    # standard deviation of the points across the patch, at least: one as narrow as the noise of ranges spans a plane of
    # rays, which moves with the sensor
    narrowest_m: float = 0.0


PATCHES = (Patch(rows=1, columns=4, gate_m=0.5), Patch(rows=1, columns=8, gate_m=2.0))
"""The first and the second try in images of 16 rows."""
# A patch wider than high takes its tilt from the noise of a ring, and ground that seems tilted holds alignment back.
FINE_PATCHES = (
    Patch(rows=2, columns=1, gate_m=0.5, narrowest_m=0.03),
    Patch(rows=2, columns=2, gate_m=2.0, narrowest_m=0.03),
)
"""The same in finer images."""


def surface_normals(image: Floats, patches: Sequence[Patch] = PATCHES) -> Floats:
    """Unit normals (3, H, W) float32 that face the sensor, zero where no patch is a plane.

    Patches are tried in turn, wrap around the seam of azimuth, and are empty above and below the image (4, H, W): x, y,
    z and range in metres, zero where empty.
    """
    rows, columns = max((one.rows for one in patches), default=0), max((one.columns for one in patches), default=0)
    height, width = image.shape[1:]
    padded = np.empty((4, height + 2 * rows, width + 2 * columns + _AT_ONCE - 1), dtype=np.float32)
    _pad(image, rows, columns, padded)
    normals = np.zeros((3, height, width), dtype=np.float32)
    for patch in patches:
        _fit_planes(padded, rows, columns, patch, normals)
    return normals


@compiled
def _pad(image: Floats, rows: int, columns: int, padded: Floats) -> None:
    """Write (4, H + 2 rows, W + 2 columns or more) columns that go round, empty rows above and below; empty is far."""
    height, width = image.shape[1:]
    for channel in range(4):
        empty = _FAR if channel == 3 else _ZERO
        for i in range(height + 2 * rows):
            row, inside = padded[channel, i], i >= rows and i < rows + height
            for j in range(len(row)):
                row[j] = empty
            if not inside:
                continue
            shown = image[channel, i - rows]
            for j in range(width):
                row[columns + j] = shown[j] if channel < 3 or shown[j] > _ZERO else _FAR
            for j in range(columns):
                row[j] = row[width + j]
            for j in range(columns + width, len(row)):
                row[j] = row[j - width]


@compiled
def _fit_planes(padded: Floats, rows: int, columns: int, patch: Patch, normals: Floats) -> None:
    """Write the normals (3, H, W) of pixels that have none yet and lie on a plane, from an image as of `_pad`."""
    height, width = normals.shape[1:]
    work, found = np.empty(15 * _STRIDE, dtype=np.float32), np.empty(3 * _STRIDE, dtype=np.float32)
    for i in range(height):
        ranges = padded[3, i + rows]
        for begin in range(0, width, _BLOCK):
            end, is_wanted = min(begin + _BLOCK, width), False
            for j in range(begin, end):
                missing = normals[0, i, j] == _ZERO and normals[1, i, j] == _ZERO and normals[2, i, j] == _ZERO
                is_wanted |= missing and ranges[columns + j] < _FAR
            if not is_wanted:
                continue
            _scatter(padded, i + rows, begin + columns, end - begin, patch, work)
            _fit(end - begin, work, patch, found)
            for j in range(begin, end):
                if normals[0, i, j] == _ZERO and normals[1, i, j] == _ZERO and normals[2, i, j] == _ZERO:
                    for axis in range(3):
                        normals[axis, i, j] = found[axis * _STRIDE + j - begin]


@compiled_part
def _scatter(padded: Floats, i: int, begin: int, size: int, patch: Patch, work: Floats) -> None:
    """Write the moments of the neighbours of a block of pixels, all of row i, about each pixel itself.

    Coordinates of tens of metres would leave no digits to float32.

    Args:
        padded, patch: as for `_fit_planes`.
        i, begin, size: row and first column in the padded image, and number of the pixels.
        work: (15 * STRIDE,), written: x, y, z and range of the pixels; of their neighbours the number, the squared
            distance of the nearest, and sums of x, y, z, xx, yy, zz, xy, yz, xz.
    """
    work[:] = _ZERO
    work[5 * _STRIDE : 6 * _STRIDE] = _FAR
    gate_m = np.float32(patch.gate_m)
    for channel in range(4):
        row = padded[channel, i]
        for k in range(size):
            work[channel * _STRIDE + k] = row[begin + k]
    for down in range(i - patch.rows, i + patch.rows + 1):
        # One by one: a slice in the middle of an index is taken as not contiguous, and would not be vectorised.
        x, y, z, ranges = padded[0, down], padded[1, down], padded[2, down], padded[3, down]
        end = begin + patch.columns + 1
        for first in range(begin - patch.columns, end, _AT_ONCE):
            last = first + size + _AT_ONCE - 1
            itself, count = begin - first if down == i else -1, end - first
            _add(size, gate_m, itself, count, x[first:last], y[first:last], z[first:last], ranges[first:last], work)


@compiled_part
def _add(
    size: int, gate_m: np.float32, itself: int, count: int,
    x: Floats, y: Floats, z: Floats, ranges: Floats, work: Floats,
) -> None:  # fmt: skip
    """Add neighbours of each pixel that are next to each other in a row to the moments, `count` of three at most.

    One of them may be the pixel itself. The more of them, the less often moments are read and written.
    """
    for k in range(size):
        px, py, pz, distance = work[k], work[_STRIDE + k], work[2 * _STRIDE + k], work[3 * _STRIDE + k]
        number, nearest = work[4 * _STRIDE + k], work[5 * _STRIDE + k]
        sx, sy, sz = work[6 * _STRIDE + k], work[7 * _STRIDE + k], work[8 * _STRIDE + k]
        sxx, syy, szz = work[9 * _STRIDE + k], work[10 * _STRIDE + k], work[11 * _STRIDE + k]
        sxy, syz, sxz = work[12 * _STRIDE + k], work[13 * _STRIDE + k], work[14 * _STRIDE + k]
        for c in range(_AT_ONCE):
            near = abs(ranges[k + c] - distance) <= gate_m and c < count
            mask = _ONE if near else _ZERO
            dx, dy, dz = (x[k + c] - px) * mask, (y[k + c] - py) * mask, (z[k + c] - pz) * mask
            xx, yy, zz = dx * dx, dy * dy, dz * dz
            apart = xx + yy + zz if near and c != itself else _FAR
            nearest = apart if apart < nearest else nearest
            number += mask
            sx, sy, sz, sxx, syy, szz = sx + dx, sy + dy, sz + dz, sxx + xx, syy + yy, szz + zz
            sxy, syz, sxz = sxy + dx * dy, syz + dy * dz, sxz + dx * dz
        work[4 * _STRIDE + k], work[5 * _STRIDE + k] = number, nearest
        work[6 * _STRIDE + k], work[7 * _STRIDE + k], work[8 * _STRIDE + k] = sx, sy, sz
        work[9 * _STRIDE + k], work[10 * _STRIDE + k], work[11 * _STRIDE + k] = sxx, syy, szz
        work[12 * _STRIDE + k], work[13 * _STRIDE + k], work[14 * _STRIDE + k] = sxy, syz, sxz


@compiled_part
def _fit(size: int, work: Floats, patch: Patch, found: Floats) -> None:
    """Write the normals (3 * STRIDE,) of a block of pixels by the moments of their neighbours; zero without a plane.

    Without branches, so that the loop is vectorised. The smallest eigenvalue is the root of the
    characteristic polynomial that Newton's method finds from below; of a plane, in few steps. Where it is not small the
    answer is too small, and still too large for a plane.
    """
    least_count, nearest_m2 = np.float32(patch.min_neighbours), np.float32(patch.nearest_m**2)
    max_flatness, min_spread = np.float32(patch.max_flatness), np.float32(patch.min_spread)
    narrowest_m = np.float32(patch.narrowest_m)
    for k in range(size):
        x, y, z, distance = work[k], work[_STRIDE + k], work[2 * _STRIDE + k], work[3 * _STRIDE + k]
        count, sx, sy, sz = work[4 * _STRIDE + k], work[6 * _STRIDE + k], work[7 * _STRIDE + k], work[8 * _STRIDE + k]
        each = _ONE / (count if count > _ONE else _ONE)
        mx, my, mz = sx * each, sy * each, sz * each
        xx, yy, zz = work[9 * _STRIDE + k] - sx * mx, work[10 * _STRIDE + k] - sy * my, work[11 * _STRIDE + k] - sz * mz
        xy, yz, xz = (
            work[12 * _STRIDE + k] - sx * my, work[13 * _STRIDE + k] - sy * mz, work[14 * _STRIDE + k] - sx * mz
        )  # fmt: skip
        # Rounding may leave next to nothing, or less, of the scatter of points that are all but one.
        size_m2 = xx + yy + zz
        is_plane = count >= least_count and work[5 * _STRIDE + k] <= nearest_m2 and size_m2 > _TINY
        scale = _ONE / (size_m2 if size_m2 > _TINY else _ONE)
        xx, yy, zz, xy, yz, xz = xx * scale, yy * scale, zz * scale, xy * scale, yz * scale, xz * scale
        # The characteristic polynomial is s^3 - s^2 + pairs s - determinant.
        pairs = (xx * yy - xy * xy) + (yy * zz - yz * yz) + (zz * xx - xz * xz)
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        s = determinant / (pairs if pairs > _TINY else _ONE)
        s = s - (((s - _ONE) * s + pairs) * s - determinant) / _slope(s, pairs)
        s = s - (((s - _ONE) * s + pairs) * s - determinant) / _slope(s, pairs)
        s = s - (((s - _ONE) * s + pairs) * s - determinant) / _slope(s, pairs)
        # The other two have the sum 1 - s and this product.
        product, half = pairs - s * (_ONE - s), _HALF * (_ONE - s)
        left = half * half - product
        largest = half + np.sqrt(left if left > _ZERO else _ZERO)
        middle = product / (largest if largest > _TINY else _ONE)
        narrowest = _NARROWEST * distance
        narrowest = narrowest if narrowest > narrowest_m else narrowest_m
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
        found[_STRIDE + k] = v * each if is_plane else _ZERO
        found[2 * _STRIDE + k] = w * each if is_plane else _ZERO


@compiled_part
def _slope(s: np.float32, pairs: np.float32) -> np.float32:
    """The derivative of the characteristic polynomial, which is positive below the smallest eigenvalue."""
    slope = (_THREE * s - _TWO) * s + pairs
    return slope if slope > _TINY else _ONE
