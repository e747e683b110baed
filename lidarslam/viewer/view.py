"""Parts of a picture: the orthographic view, clouds as shaded pixels, paths, and the strip with legend and scale."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.report.drawing import ramp

WIDTH = 1600
# Height of a picture and its margin, relative to its width.
_TALLEST, _LOWEST, _MARGIN = 0.625, 0.2, 0.025
# The frame holds this share of the occupied cells, along each axis, and up to this share of the size beyond.
_FRAMED_PERCENT, _BEYOND = (0.5, 99.5), 0.3
_CELLS = 300
_SAMPLED = 5_000
# The picture is turned only where this saves much empty space.
_TURNS_DEG = (*range(0, 95, 5), *range(-85, 0, 5))
_WORTH_TURNING = 1.2
_LEAST_SIZE_M = 1.0
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
# Surfaces that face away by more than this are left out, so that rooms are visible through ceilings.
_LEAST_FACING = -0.1


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
    def turn_deg(self) -> float:
        """Of the picture about z."""
        return float(np.rad2deg(np.arctan2(self.axes[0, 1], self.axes[0, 0])))

    def project(self, points: FloatArray) -> FloatArray:
        """Column and row (N, 2) of points (N, 3); pixel centres are at whole numbers."""
        across = (points @ self.axes[:2].T - self.centre) / self.pixel_m
        middle = 0.5 * np.array([self.width, self.height]) - 0.5
        return np.asarray(across * [1.0, -1.0] + middle, dtype=np.float64)

    def enlarged(self, factor: int) -> "View":
        """The same part of the scene on more pixels."""
        return replace(self, pixel_m=self.pixel_m / factor, width=self.width * factor, height=self.height * factor)


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

    Without a turn about z, it is the one that leaves the least empty space seen from above, whatever the elevation of
    the camera above the horizon; 0 unless it saves much. The height of the picture follows the scene.
    """
    if turn_deg is None:
        sample = points[:: max(1, len(points) // _SAMPLED)]
        views = {turn: _fit(view_axes(turn, 90.0), sample, path, width) for turn in _TURNS_DEG}
        areas = {turn: view.width * view.height * view.pixel_m**2 for turn, view in views.items()}
        best = min(areas, key=lambda turn: areas[turn])
        turn_deg = float(best) if areas[0] > _WORTH_TURNING * areas[best] else 0.0
    return _fit(view_axes(turn_deg, elevation_deg), points, path, width)


def _fit(axes: FloatArray, points: FloatArray, path: FloatArray, width: int) -> View:
    box, margin = _box(axes, points, path), round(_MARGIN * width)
    size_m, tallest, lowest = box[1] - box[0], round(_TALLEST * width), round(_LOWEST * width)
    pixel_m = float((size_m / [width - 2 * margin, tallest - 2 * margin]).max())
    height = int(np.clip(np.ceil(size_m[1] / pixel_m) + 2 * margin, lowest, tallest))
    return View(axes, box.mean(axis=0), pixel_m, width, height, size_m)


def _box(axes: FloatArray, points: FloatArray, path: FloatArray) -> FloatArray:
    """Lower and upper corner (2, 2) along right and up."""
    parts = [path @ axes[:2].T] + ([_occupied(points @ axes[:2].T)] if len(points) else [])
    across = np.concatenate(parts) if len(points) or len(path) else np.zeros((1, 2))
    low, high = across.min(axis=0), across.max(axis=0)
    short = np.maximum(_LEAST_SIZE_M - (high - low), 0.0) / 2.0
    return np.stack([low - short, high + short])


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
    towards = points @ view.axes[2]
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


_CLIPPED = (2.0, 98.0)  # percent
Colour = tuple[int, int, int]
INK, PAPER, HALO = (20, 20, 20), (255, 255, 255), (255, 255, 255)
START = (255, 225, 40)
# Of the picture's width.
_TEXT, _LINE, _MARKER = 1 / 58, 1 / 320, 1 / 130
_LONGEST_BAR = 0.2
_END_WIDENING = 0.25  # of the marks of wide paths, relative to that of the paths
_LONGEST_NAME = 32

HEIGHT_COLOURS = ramp(
    np.linspace(0.0, 1.0, 256), [(201, 209, 214), (140, 181, 199), (66, 138, 166), (41, 84, 135), (60, 28, 92)]
)
"""(256, 3) from low to high, on white paper: light ground, dark tops."""


@dataclass(frozen=True)
class HeightScale:
    """Heights as colours; the lowest and highest 2 % are clipped."""

    # low, high: of the heights in between, metres
    low: float
    high: float

    @property
    def ends(self) -> tuple[str, str]:
        """The labels on both sides of the scale."""
        return f"z {self.low:.1f}", f"{self.high:.1f} m"

    def colours(self, heights: FloatArray) -> NDArray[np.uint8]:
        """Colours (N, 3) of heights (N,)."""
        level = (heights - self.low) * (255.0 / max(self.high - self.low, 1e-6))
        return HEIGHT_COLOURS[np.clip(level, 0.0, 255.0).astype(np.uint8)]


def levels(values: FloatArray) -> FloatArray:
    """Values (N,) from 0 to 1, the lowest and highest 2 % clipped."""
    if not len(values):
        return values
    low, high = np.percentile(values, _CLIPPED)
    return np.asarray(np.clip((values - low) / max(high - low, 1e-6), 0.0, 1.0))


def fit_scale(heights: FloatArray) -> HeightScale | None:
    """The scale that suits heights (N,); None without any."""
    return HeightScale(*map(float, np.percentile(heights, _CLIPPED))) if len(heights) else None


@dataclass(frozen=True, eq=False)
class Entry:
    """A part of the strip: a symbol and its text."""

    text: str
    symbol_width: int = 0  # pixels
    # draws the symbol from a column on, about a row
    symbol: Callable[[ImageDraw.ImageDraw, float, float], None] | None = None


def draw_path(picture: Image.Image, view: View, positions: FloatArray, colours: Sequence[Colour], wider: float) -> None:
    """Draw a path through positions (N, 3) above everything, in the colours of its poses, widened by a factor."""
    pixels = view.project(positions)
    for first, last in _stretches(colours):
        _line(picture, pixels[first : last + 1], colours[last], wider * max(2.0, view.width * _LINE))


def draw_end(picture: Image.Image, view: View, position: FloatArray, colour: Colour, wider: float = 1.0) -> None:
    """Mark the first position (1, 3) with a disc, the last with a square of the colour; (0, 3): nothing."""
    for column, row in view.project(position).tolist():
        radius = view.width * _MARKER * (1.0 + _END_WIDENING * (wider - 1.0))
        _mark(ImageDraw.Draw(picture), column, row, radius, colour)


def line_entry(text: str, colour: Colour, width: int, wider: float = 1.0) -> Entry:
    """A line of the legend."""
    length, thick = round(width / 45), max(3, round((0.2 + wider) * width * _LINE))

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        pen.line([(column, row), (column + length, row)], fill=colour, width=thick)

    return Entry(short(text), length, symbol)


def end_entry(text: str, colour: Colour, width: int) -> Entry:
    """The mark of the first or the last pose in the legend."""
    radius = width * _MARKER

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        _mark(pen, column + radius, row, radius, colour)

    return Entry(text, round(2 * radius), symbol)


def ramp_entry(low: str, high: str, colours: NDArray[np.uint8], width: int) -> Entry:
    """A scale of colours (K, 3) from `low` to `high`."""
    height, font = round(width * _TEXT * 0.7), _font(width)
    before = round(font.getlength(low)) + round(width / 160)

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        pen.text((column, row), low, fill=INK, font=font, anchor="lm")
        for step, colour in enumerate(colours.tolist()):
            left = column + before + step
            pen.line([(left, row - height / 2), (left, row + height / 2)], tuple(colour))

    return Entry(high, before + len(colours), symbol)


def scale_entry(view: View) -> Entry:
    """The scale bar; its length is that of the text."""
    metres = round_length(_LONGEST_BAR * view.width * view.pixel_m)
    length, tick, thick = round(metres / view.pixel_m), view.width / 200, max(2, round(view.width / 500))

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        left, right = round(column), round(column) + length
        pen.rectangle([left, row - thick / 2, right - 1, row + thick / 2], fill=INK)
        for end in (left, right - thick):
            pen.rectangle([end, row - tick, end + thick - 1, row + tick], fill=INK)

    return Entry(f"{metres:g} m", length, symbol)


def round_length(longest_m: float) -> float:
    """The longest of 1, 2, 5, 10, 20, 50, ... m, or decimal parts of them, up to a length."""
    power = 10.0 ** np.floor(np.log10(longest_m))
    return float(power * max(digit for digit in (1, 2, 5) if digit * power <= longest_m * (1.0 + 1e-9)))


def with_strip(picture: Image.Image, entries: Sequence[Entry]) -> Image.Image:
    """The picture above a strip with the entries from left to right, in as many rows as they need."""
    width, font, gap = picture.width, _font(picture.width), round(picture.width / 45)
    text_gap, margin, row_height = round(width / 160), round(width / 40), round(width * _TEXT * 2.0)
    rows: list[list[tuple[int, Entry]]] = [[]]
    column = margin
    for entry in entries:
        taken = entry.symbol_width + text_gap + round(font.getlength(entry.text))
        if rows[-1] and column + taken > width - margin:
            rows.append([])
            column = margin
        rows[-1].append((column, entry))
        column += taken + gap
    whole = Image.new("RGB", (width, picture.height + row_height * len(rows) + row_height // 2), PAPER)
    whole.paste(picture, (0, 0))
    pen = ImageDraw.Draw(whole)
    for number, row in enumerate(rows):
        middle = picture.height + row_height * (number + 0.5) + row_height // 4
        for column, entry in row:
            if entry.symbol is not None:
                entry.symbol(pen, column, middle)
            text_column = column + entry.symbol_width + text_gap
            pen.text((text_column, middle), entry.text, fill=INK, font=font, anchor="lm")
    return whole


def _font(width: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(width * _TEXT)


def short(text: str) -> str:
    """The text, shortened, without the characters that Pillow's font lacks."""
    text = text.encode("ascii", "replace").decode()
    return text if len(text) <= _LONGEST_NAME else f"{text[: _LONGEST_NAME - 3]}..."


def _mark(pen: ImageDraw.ImageDraw, column: float, row: float, radius: float, colour: Colour) -> None:
    box = [column - radius, row - radius, column + radius, row + radius]
    draw = pen.ellipse if colour == START else pen.rectangle
    draw(box, fill=colour, outline=INK if colour == START else HALO, width=max(1, round(radius / 4)))


def _line(picture: Image.Image, pixels: FloatArray, colour: Colour, width: float) -> None:
    """A line (N, 2) with round joints; Pillow's own leave gaps between short pieces."""
    pen, radius = ImageDraw.Draw(picture), 0.5 * width
    pen.line(pixels.ravel().tolist(), fill=colour, width=round(width))
    for column, row in pixels.tolist():
        pen.ellipse([column - radius, row - radius, column + radius, row + radius], fill=colour)


def _stretches(colours: Sequence[Colour]) -> list[tuple[int, int]]:
    """First and last pose of each stretch of one colour; a stretch begins at the pose before it."""
    ends = [row for row in range(1, len(colours)) if row + 1 == len(colours) or colours[row + 1] != colours[row]]
    return list(zip([0, *ends[:-1]], ends, strict=True)) if ends else []
