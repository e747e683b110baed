"""The view of a picture: an orthographic projection, so that one scale bar holds everywhere."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray

WIDTH = 1600
# Height of a picture and its margin, relative to its width.
_TALLEST, _LOWEST, _MARGIN = 0.625, 0.2, 0.025
# The frame holds this share of the occupied cells, along each axis, and up to so much of the size beyond.
_FRAMED_PERCENT, _BEYOND = (0.5, 99.5), 0.3
_CELLS = 300
_SAMPLED = 5_000
# The picture is turned only where this saves much empty space.
_TURNS_DEG = (*range(0, 95, 5), *range(-85, 0, 5))
_WORTH_TURNING = 1.2
_LEAST_SIZE_M = 1.0


@dataclass(frozen=True, eq=False)
class View:
    """An orthographic view, and the part of the scene that the picture shows."""

    axes: FloatArray  # (3, 3) unit vectors in the world, in rows: right, up, towards the camera
    centre: FloatArray  # (2,) along right and up, at the middle of the picture, m
    pixel_m: float  # edge of a pixel
    # width, height: of the picture, pixels
    width: int
    height: int
    size_m: FloatArray  # (2,) of the scene along right and up; the picture shows a margin around it

    @property
    def area_m2(self) -> float:
        """What the picture shows."""
        return self.width * self.height * self.pixel_m**2

    @property
    def turn_deg(self) -> float:
        """Of the picture about z."""
        return float(np.rad2deg(np.arctan2(self.axes[0, 1], self.axes[0, 0])))

    def project(self, points: FloatArray) -> FloatArray:
        """Column and row (N, 2) of points (N, 3); pixel centres are at whole numbers."""
        across = (points @ self.axes[:2].T - self.centre) / self.pixel_m
        middle = 0.5 * np.array([self.width, self.height]) - 0.5
        return np.asarray(across * [1.0, -1.0] + middle, dtype=np.float64)

    def depth(self, points: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 3) towards the camera, m."""
        depth: FloatArray = points @ self.axes[2]
        return depth

    def enlarged(self, factor: int) -> "View":
        """The same part of the scene on more pixels."""
        width, height = self.width * factor, self.height * factor
        return replace(self, pixel_m=self.pixel_m / factor, width=width, height=height)


def view_axes(turn_deg: float, elevation_deg: float) -> FloatArray:
    """Right, up and towards the camera (3, 3), in rows; right is x turned about z, 90 degrees look straight down."""
    turn, elevation = np.deg2rad([turn_deg, elevation_deg])
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    towards = np.array([np.cos(elevation) * np.sin(turn), -np.cos(elevation) * np.cos(turn), np.sin(elevation)])
    return np.stack([right, np.cross(towards, right), towards])


def fit_view(
    points: FloatArray, path: FloatArray, elevation_deg: float = 90.0, turn_deg: float | None = None, width: int = WIDTH
) -> View:
    """The view that holds points (N, 3), but for strays, and the whole path (M, 3).

    Args:
        points: of all clouds; may be empty.
        path: positions of all trajectories; may be empty.
        elevation_deg: of the camera above the horizon.
        turn_deg: of the picture about z; None: the turn that leaves the least empty space seen from above, whatever the
            elevation; 0 unless it saves much.
        width: of the picture, pixels; its height follows the scene.
    """
    if turn_deg is None:
        sample = points[:: max(1, len(points) // _SAMPLED)]
        areas = {turn: _fit(view_axes(turn, 90.0), sample, path, width).area_m2 for turn in _TURNS_DEG}
        best = min(areas, key=lambda turn: areas[turn])
        turn_deg = float(best) if areas[0] > _WORTH_TURNING * areas[best] else 0.0
    return _fit(view_axes(turn_deg, elevation_deg), points, path, width)


def turning_views(
    points: FloatArray, path: FloatArray, elevation_deg: float, turns_deg: Sequence[float], width: int
) -> list[View]:
    """Views about the vertical through the middle of the scene, one for each turn, all of one scale; see `fit_view`."""
    sample = points[:: max(1, len(points) // _SAMPLED)]
    # The middle of the scene, in the world.
    middle = np.mean([_box(np.roll(np.eye(3), -axis, axis=0), sample, path)[:, 0] for axis in range(3)], axis=1)
    axes = [view_axes(turn_deg, elevation_deg) for turn_deg in turns_deg]
    reach = np.max([np.abs(_box(of, sample, path) - of[:2] @ middle) for of in axes], axis=(0, 1))
    return [_view(of, of[:2] @ middle, 2.0 * reach, width) for of in axes]


def _fit(axes: FloatArray, points: FloatArray, path: FloatArray, width: int) -> View:
    box = _box(axes, points, path)
    return _view(axes, box.mean(axis=0), box[1] - box[0], width)


def _view(axes: FloatArray, centre: FloatArray, size_m: FloatArray, width: int) -> View:
    margin = round(_MARGIN * width)
    tallest, lowest = round(_TALLEST * width), round(_LOWEST * width)
    pixel_m = float((size_m / [width - 2 * margin, tallest - 2 * margin]).max())
    height = int(np.clip(np.ceil(size_m[1] / pixel_m) + 2 * margin, lowest, tallest))
    return View(axes, centre, pixel_m, width, height, size_m)


def _box(axes: FloatArray, points: FloatArray, path: FloatArray) -> FloatArray:
    """Lower and upper corner (2, 2) along right and up."""
    corners = []
    if len(points):
        corners.append(_occupied(points @ axes[:2].T))
    if len(path):
        across = path @ axes[:2].T
        corners.append(np.stack([across.min(axis=0), across.max(axis=0)]))
    if not corners:
        return np.array([[-0.5, -0.5], [0.5, 0.5]]) * _LEAST_SIZE_M
    box = np.stack([np.min(corners, axis=0)[0], np.max(corners, axis=0)[1]])
    short = np.maximum(_LEAST_SIZE_M - (box[1] - box[0]), 0.0) / 2.0
    return np.stack([box[0] - short, box[1] + short])


def _occupied(across: FloatArray) -> FloatArray:
    """Corners of the occupied cells, so that dense places do not count more than the ends of a long drive."""
    low, high = across.min(axis=0), across.max(axis=0)
    inner_low, inner_high = np.percentile(across, _FRAMED_PERCENT, axis=0)  # strays would make the cells large
    cell_m = max(float((inner_high - inner_low).max()) / _CELLS, 1e-6)
    row = np.floor((across - low) / cell_m).astype(np.int64) @ np.array([1, 1 << 32])
    cells = across[np.unique(row, return_index=True)[1]]
    inner_low, inner_high = np.percentile(cells, _FRAMED_PERCENT, axis=0)
    beyond = _BEYOND * (inner_high - inner_low) + cell_m
    return np.stack([np.maximum(low, inner_low - beyond), np.minimum(high, inner_high + beyond)])
