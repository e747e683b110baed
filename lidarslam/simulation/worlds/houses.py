"""Town houses: facades of piers and bands before a recessed core, bays, balconies, roofs.

A house is drawn in its own frame: the origin at the left end of its front as seen from within, x along the front, y
into the house, z up from the pavement.
"""

from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import Builder, starting

# Walls go this far down: houses stand level on streets that slope.
_FOUNDATION_M = 2.0
# Faces that would be in one plane are set apart by this much.
_OFFSET_M = 0.02


class _Style(NamedTuple):
    """Measures that all facades of one house share."""

    storeys: int
    storey_m: float  # height of a storey
    recess_m: float  # of the windows behind the wall
    axis_m: float  # about the distance between windows
    opening: float  # share of it that is window
    sill_m: float  # lower and upper edge of a window above its floor
    lintel_m: float
    ground_sill_m: float  # the same on the ground floor
    ground_lintel_m: float

    @property
    def top_m(self) -> float:
        return self.storeys * self.storey_m + 0.3

    def openings(self, width: float) -> FloatArray:
        """(K, 2) where along a facade each column of windows starts and ends."""
        columns = max(1, round(width / self.axis_m))
        pitch = width / columns
        middle = pitch * (np.arange(columns) + 0.5)
        return middle[:, None] + 0.5 * self.opening * pitch * np.array([-1.0, 1.0])


def house(
    rng: np.random.Generator, width: float, depth: float, open_sides: tuple[bool, bool],
    storeys: tuple[int, int] = (2, 5), is_plain: bool = False,
) -> Builder:  # fmt: skip
    """A house between the fewest and most storeys, its left and right sides with windows where they are open.

    A plain one has few wide windows and no ornaments, for streets of many kilometres.
    """
    part = Builder()
    style = _draw_style(rng, storeys, 3.0 if is_plain else 1.0)
    recess, top = style.recess_m, style.top_m
    x0, x1 = recess * open_sides[0], width - recess * open_sides[1]
    openings = style.openings(width)
    door = int(rng.integers(len(openings)))
    passage = bool(width > 9.0 and rng.random() < 0.2)
    if passage:  # a way through to the yard in place of the door
        middle = float(openings[door].mean())
        a, b = max(middle - 1.4, 0.4), min(middle + 1.4, width - 0.4)
        part.block([(x0, a), (b, x1)], (recess, depth), (-_FOUNDATION_M, 3.0))
        part.block((x0, x1), (recess, depth), (3.0, top))
        before, after = openings[openings[:, 1] < a - 0.1], openings[openings[:, 0] > b + 0.1]
        openings, door = np.concatenate([before, [[a, b]], after]), len(before)
    else:
        part.block((x0, x1), (recess, depth), (-_FOUNDATION_M, top))
    _facade(part, style, width, openings, door, passage)
    if not is_plain:
        _ornaments(part, rng, style, openings, door)
    for is_open, corner, yaw in zip(open_sides, ((0.0, depth), (width, 0.0)), (-0.5 * np.pi, 0.5 * np.pi), strict=True):
        if is_open:
            _facade(part.shifted(*corner, yaw=yaw), style, depth, style.openings(depth))
    _roof(part, rng, width, depth, top)
    return part


def _draw_style(rng: np.random.Generator, storeys: tuple[int, int], spread: float) -> _Style:
    storey = rng.uniform(2.9, 3.5)
    is_shop = rng.random() < 0.3
    sill = rng.uniform(0.7, 1.0)
    count, recess = int(rng.integers(*storeys, endpoint=True)), rng.uniform(0.14, 0.38)
    axis, opening = spread * rng.uniform(2.1, 3.4), rng.uniform(0.4, 0.62)
    lintel = rng.uniform(sill + 1.2, storey - 0.25)
    ground = (0.35, 2.6) if is_shop else (sill + 0.1, rng.uniform(2.2, 2.6))
    return _Style(count, storey, recess, axis, opening, sill, lintel, *ground)


def _facade(
    part: Builder, style: _Style, width: float, openings: FloatArray, door: int = -1, is_passage: bool = False
) -> None:
    """Piers between the columns of windows, bands between the storeys; the column `door` is open to the ground."""
    back, top = style.recess_m + _OFFSET_M, style.top_m
    for x0, x1 in np.concatenate([[0.0], openings.ravel(), [width]]).reshape(-1, 2):
        if x1 - x0 > 0.05:
            part.block((x0, x1), (0.0, back), (-_FOUNDATION_M, top))
    sills = [style.ground_sill_m, *(style.storey_m * k + style.sill_m for k in range(1, style.storeys)), top]
    lintels = [style.ground_lintel_m, *(style.storey_m * k + style.lintel_m for k in range(1, style.storeys))]
    part.block((0.01, width - 0.01), (_OFFSET_M, back), np.column_stack([lintels, sills[1:]]))
    stretches = np.array([0.01, *(openings[door] if door >= 0 else ()), width - 0.01])
    part.block(stretches, (_OFFSET_M, back), (-_FOUNDATION_M, sills[0]))
    if door >= 0 and not is_passage:
        part.block((openings[door, 0], openings[door, 1]), (-0.32, back), (-0.6, 0.14))


def _ornaments(part: Builder, rng: np.random.Generator, style: _Style, openings: FloatArray, door: int) -> None:
    """Downpipe, awning, and a bay or balconies on the upper floors."""
    end = float(openings[-1, 1])
    part.pole((rng.choice([0.12, end + 0.2]), -0.07), (-0.5, style.top_m - 0.1), 0.05)
    if style.ground_sill_m < 0.5 and rng.random() < 0.7:
        part.beam((0.5 * end, -rng.uniform(0.9, 1.3), 2.55), (0.5 * end, 0.05, 3.0), 0.85 * end, 0.05)
    elif rng.random() < 0.35:
        _bay(part, style, openings[int(rng.integers(len(openings)))], rng.uniform(0.5, 0.9))
    if rng.random() < 0.35:
        for column in np.flatnonzero(rng.random(len(openings)) < 0.3):
            for storey in range(1, style.storeys):
                if column != door and rng.random() < 0.7:
                    _balcony(part, openings[column], storey * style.storey_m, rng.uniform(0.8, 1.2))


def _bay(part: Builder, style: _Style, opening: FloatArray, reach: float) -> None:
    """A box with windows of its own before the upper floors of one column."""
    x0, x1 = opening[0] - 0.25, opening[1] + 0.25
    low, high = style.storey_m - 0.05, style.top_m - 0.4
    part.block((x0 + 0.1, x1 - 0.1), (-reach + 0.12, 0.1), (low, high))
    part.block(starting((x0, x1 - 0.16), 0.16), (-reach, -reach + 0.2), (low, high))
    for k in range(1, style.storeys + 1):
        z0 = low if k == 1 else (k - 1) * style.storey_m + style.lintel_m
        z1 = high if k == style.storeys else k * style.storey_m + style.sill_m
        if z1 - z0 > 0.05:
            part.block((x0 + _OFFSET_M, x1 - _OFFSET_M), (-reach + _OFFSET_M, 0.1), (z0, z1))


def _balcony(part: Builder, opening: FloatArray, floor: float, reach: float) -> None:
    x0, x1 = opening[0] - 0.3, opening[1] + 0.3
    part.blocks((x0, x1, -reach, 0.1, floor - 0.16, floor), (x0, x1, -reach, -reach + 0.05, floor + 0.95, floor + 1.0))
    part.block(starting((x0, x1 - 0.05), 0.04), (-reach + 0.06, 0.05), (floor + 0.1, floor + 1.0))
    bars = starting(np.linspace(x0, x1 - 0.04, max(3, round((x1 - x0) / 0.5))), 0.04)
    part.block(bars, (-reach + 0.01, -reach + 0.04), (floor - 0.02, floor + 0.96))


def _roof(part: Builder, rng: np.random.Generator, width: float, depth: float, top: float) -> None:
    """A cornice, and a flat roof behind a parapet or a pitched one with its eaves to the street; a chimney."""
    part.block((-0.01, width + 0.01), (-0.22, 0.3), (top - 0.05, top + 0.18))
    if rng.random() < 0.45:
        high = top + rng.uniform(0.5, 0.9)
        part.block((0.0, width), starting((0.0, depth - 0.3), 0.28), (top, high))
        x = rng.uniform(0.2, 0.6) * width
        part.block((x, x + 2.4), (0.4 * depth, 0.4 * depth + 3.0), (top, top + 2.4))
    else:
        ridge = top + rng.uniform(0.5, 1.0) * 0.5 * depth
        for eave in (-0.35, depth + 0.35):
            part.beam((0.5 * width, eave, top + 0.1), (0.5 * width, 0.5 * depth, ridge), width, 0.2)
        for fraction in (0.2, 0.5, 0.8):
            inset = 0.5 * depth * fraction
            high = top + fraction * (ridge - top)
            part.block((0.05, width - 0.05), (inset, depth - inset), (top - 0.1, high))
    x, y = rng.uniform(0.1, 0.85) * width, rng.uniform(0.55, 0.8) * depth
    part.block((x, x + 0.9), (y, y + 0.5), (top - 0.1, top + rng.uniform(2.0, 4.0)))
