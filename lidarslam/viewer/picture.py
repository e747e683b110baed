"""A point cloud as a picture, drawn without a window or a graphics card."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import OutputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.report.error_colours import viridis

_BACKGROUND = (255, 255, 255)
# How far away the camera stands, in diameters of the cloud: near enough for perspective.
_DISTANCE = 1.2
# What must be in view, as percentiles: a few stray points do not count.
_FRAMED_PERCENT = (0.2, 99.8)
_FILLED = 0.92
# Eye-dome lighting (Boucheny, 2009): how strongly a pixel behind its neighbours is darkened.
_EDGE_STRENGTH = 12.0
_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Camera:
    """Where a cloud is looked at from."""

    azimuth_deg: float = -120.0  # direction the camera looks from, counter-clockwise from x
    elevation_deg: float = 40.0  # how far above the horizon; 90 looks straight down
    # width, height: of the picture, pixels
    width: int = 1600
    height: int = 900

    @property
    def towards(self) -> FloatArray:
        """Unit vector (3,) from the cloud towards the camera."""
        azimuth, elevation = np.deg2rad([self.azimuth_deg, self.elevation_deg])
        horizontal = np.cos(elevation)
        return np.array([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)])


def height_colours(points: FloatArray) -> NDArray[np.uint8]:
    """Colours (N, 3) by the height of points (N, 3), the lowest and highest 2 % clipped."""
    if not len(points):
        return np.empty((0, 3), dtype=np.uint8)
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    return viridis(np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0))


def draw(
    points: FloatArray,
    colours: NDArray[np.uint8],
    normals: FloatArray | None = None,
    camera: Camera | None = None,
) -> NDArray[np.uint8]:
    """The picture (height, width, 3) of points (N, 3) with colours (N, 3), in perspective, shaded by depth.

    Surfaces whose normals (N, 3) face away are left out, so that one looks through ceilings and near walls into rooms.
    Nearly all of the points are in view and fill the picture.
    """
    camera = camera or Camera()
    if normals is not None and len(points):
        facing = normals @ camera.towards > -0.1
        points, colours = points[facing], colours[facing]
    seen = _to_camera(points, camera)
    depth, index = _rasterise(seen, camera)
    picture = np.full((camera.height, camera.width, 3), _BACKGROUND, dtype=np.uint8)
    covered = index >= 0
    shade = _eye_dome(depth)[covered, None]
    picture[covered] = (colours[index[covered]] * shade).astype(np.uint8)
    return picture


def save_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture (height, width, 3) as .png, .jpg or .jpeg.

    Raises:
        OutputError: it cannot be written.
    """
    from PIL import Image

    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: a picture must end in .png or .jpg")
    try:
        with replacing(path) as partial:
            Image.fromarray(picture).save(partial)
    except OSError as error:
        raise cannot_write(path, error) from error


def _to_camera(points: FloatArray, camera: Camera) -> FloatArray:
    """Points (N, 3) as pixel column, pixel row and depth; nearly all of them fill the picture."""
    if not len(points):
        return np.empty((0, 3))
    towards, azimuth = camera.towards, np.deg2rad(camera.azimuth_deg)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(towards, right)
    low, high = np.percentile(points, _FRAMED_PERCENT, axis=0)
    view = (points - 0.5 * (low + high)) @ np.stack([right, -up, towards], axis=1)
    distance = _DISTANCE * max(float(np.linalg.norm(high - low)), 1e-3)
    depth = distance - view[:, 2]
    plane = view[:, :2] / np.where(depth > 0.0, depth, np.nan)[:, None]
    low, high = np.nanpercentile(plane, _FRAMED_PERCENT, axis=0)
    size = np.array([camera.width, camera.height])
    zoom = float((_FILLED * size / np.maximum(high - low, 1e-9)).min())
    return np.column_stack([0.5 * size + zoom * (plane - 0.5 * (low + high)), depth])


def _rasterise(seen: FloatArray, camera: Camera, splat: int = 2) -> tuple[FloatArray, NDArray[np.int64]]:
    """Depth (inf where empty) and index (-1 where empty) of the nearest point at every pixel."""
    order = np.flatnonzero(np.isfinite(seen).all(axis=1))
    order = order[np.argsort(-seen[order, 2], kind="stable")]  # nearest last, so that it stays
    depth = np.full((camera.height, camera.width), np.inf)
    index = np.full((camera.height, camera.width), -1, dtype=np.int64)
    corner = np.floor(seen[order, :2]).astype(np.int64)
    offsets = np.stack(np.meshgrid(range(splat), range(splat), indexing="ij"), axis=-1).reshape(-1, 2)
    pixels = (corner[:, None] + offsets).reshape(-1, 2)
    owner = np.repeat(order, len(offsets))
    inside = (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    column, row = pixels[inside].T
    depth[row, column] = seen[owner[inside], 2]
    index[row, column] = owner[inside]
    return depth, index


def _eye_dome(depth: FloatArray) -> FloatArray:
    """Brightness (0 to 1) of every pixel: darker the farther it lies behind its neighbours."""
    far = np.where(np.isfinite(depth), depth, np.nanmax(depth[np.isfinite(depth)], initial=1.0))
    logarithm = np.log2(far)
    behind = np.zeros_like(depth)
    for step, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1), (2, 0), (-2, 0), (2, 1), (-2, 1)):
        behind += np.maximum(0.0, logarithm - np.roll(logarithm, step, axis=axis))
    return np.exp(-_EDGE_STRENGTH * behind / 8.0)
