"""Clouds as shaded pixels: the nearest point at every pixel, its brightness by light and depth."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.viewer.drawing.view import View

# Points are drawn as squares that close the gaps between neighbours, up to this share of the width.
_LARGEST_SPLAT = 1 / 60
_GAPS_CLOSED = 1.7
_SAMPLED_PLACES, _SAMPLED_POINTS = 5, 400
# The light comes from the upper left of the picture, along right, up and towards the camera.
_LIGHT = np.array([-0.45, 0.5, 0.74])
_AMBIENT = 0.55
# Eye-dome lighting (Boucheny, 2009): distances of the neighbours in splats, and how strongly a pixel behind them is
# darkened.
_REACHES, _EDGE_STRENGTH, _STEEPEST = (1, 3), 0.8, 4.0
_NOTHING = np.float32(-1e9)  # depth where there is no point, behind all points
# Surfaces that face away by more than this are left out, so that one looks through ceilings into rooms.
_LEAST_FACING = -0.1


@dataclass(frozen=True, eq=False)
class Layer:
    """One cloud, drawn: the K pixels where there is a point."""

    # (K,): the pixel's number in the picture, row by row; the row of the point; brightness from 0 to 1
    pixels: NDArray[np.intp]
    points: NDArray[np.intp]
    brightness: NDArray[np.float32]


def draw_layer(points: FloatArray, normals: FloatArray, view: View) -> Layer:
    """Draw points (N, 3) with normals (N, 3); surfaces that face away are left out."""
    splat = int(np.clip(np.ceil(_GAPS_CLOSED * spacing_m(points) / view.pixel_m), 1, _LARGEST_SPLAT * view.width))
    towards = view.depth(points)
    facing = np.flatnonzero(normals @ view.axes[2] > _LEAST_FACING)
    index = _rasterise(view.project(points), facing[np.argsort(towards[facing])], view, splat)
    pixels = np.flatnonzero(index >= 0)
    seen = index.reshape(-1)[pixels]
    depth = (towards - towards.mean()).astype(np.float32)[seen]
    return Layer(pixels, seen, _lit(normals, view)[seen] * _eye_dome(depth, pixels, view, splat))


def spacing_m(points: FloatArray) -> float:
    """Median distance between neighbouring points (N, 3), from a few places."""
    if len(points) < 2:
        return 0.0
    distances: list[FloatArray] = []
    for place in points[:: max(1, len(points) // _SAMPLED_PLACES)][:_SAMPLED_PLACES]:
        count = min(_SAMPLED_POINTS, len(points))
        near = points[np.argpartition(((points - place) ** 2).sum(axis=1), count - 1)[:count]]
        distances.append(np.asarray(cKDTree(near).query(near, k=2)[0])[:, 1])
    return float(np.median(np.concatenate(distances)))


def _rasterise(pixels: FloatArray, order: NDArray[np.intp], view: View, splat: int) -> NDArray[np.intp]:
    """Row of the nearest point at every pixel (height, width), -1 where there is none; the nearest is last in order."""
    column, row = np.round(pixels[order]).astype(np.int64).T
    inside = np.flatnonzero((column >= 0) & (column < view.width) & (row >= 0) & (row < view.height))
    rank = np.full((view.height, view.width), -1, dtype=np.int32)
    rank[row[inside], column[inside]] = inside  # of several points at a pixel the last stays
    rank = maximum_filter(rank, size=splat, mode="constant", cval=-1)
    return np.append(order, -1)[rank]


def _lit(normals: FloatArray, view: View) -> NDArray[np.float32]:
    """Brightness (N,) of surfaces by their angle to the light."""
    light = _LIGHT / np.linalg.norm(_LIGHT) @ view.axes
    lit: FloatArray = _AMBIENT + (1.0 - _AMBIENT) * np.maximum(normals @ light, 0.0)
    return lit.astype(np.float32)


def _eye_dome(depth: NDArray[np.float32], pixels: NDArray[np.intp], view: View, splat: int) -> NDArray[np.float32]:
    """Brightness (K,): darker the farther a pixel lies behind its neighbours, relative to their distance.

    Opposite neighbours count together, so that a plane has no shade however it is inclined.
    """
    border = max(_REACHES) * splat
    width = view.width + 2 * border
    framed = np.full((view.height + 2 * border) * width, _NOTHING)
    middle = (pixels // view.width + border) * width + pixels % view.width + border
    framed[middle] = depth
    behind = np.zeros_like(depth)
    for reach, stride in product([splat * reach for reach in _REACHES], (1, width)):
        pair = np.zeros_like(depth)
        for neighbour in (framed[middle - reach * stride], framed[middle + reach * stride]):
            step = np.clip((neighbour - depth) / np.float32(reach * view.pixel_m), -_STEEPEST, _STEEPEST)
            pair += np.where(neighbour == _NOTHING, np.float32(0.0), step)
        behind += np.maximum(pair, 0.0)
    darkness: NDArray[np.float32] = behind * np.float32(_EDGE_STRENGTH / (2 * len(_REACHES)))
    return np.exp(-darkness)
