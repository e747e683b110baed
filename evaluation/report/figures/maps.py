"""Maps from above, each point coloured by how far it lies from the reference map."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.comparison import MapErrors, SequenceComparison
from evaluation.report.error_colours import error_colours
from evaluation.report.figures.figure import Figure
from evaluation.report.figures.panel import FONT, Panel, draw_panel, draw_width, scale_ticks, text
from evaluation.report.figures.png import data_uri, indexed_png
from evaluation.report.figures.scale import Scale, round_up, tick_texts, ticks, widened
from evaluation.report.markup import Markup, element
from lidarslam.core.geometry import FloatArray

_WIDTH, _TALLEST, _FLATTEST = 540.0, 460.0, 160.0
_COLOURS = 64
_OVERSAMPLING = 1.5
# The map's colours are read from far to near, so that large errors stand out on white paper; the palest tenth is left.
_PALEST = 0.9


def map_figure(sequence: SequenceComparison) -> Figure | None:
    """A picture of each map that has errors; None when none has."""
    maps = [(m.name, m.map_errors) for m in sequence.methods if m.map_errors is not None and len(m.map_errors.points)]
    if not maps:
        return None
    worst_m = _colour_range([errors for _, errors in maps])
    box = _box([errors for _, errors in maps])
    return Figure(
        title="Distance of map points from the reference map",
        caption=(
            "Each method's map from above, y over x in metres; the colour of a pixel is the median distance of its"
            f" points to the nearest point of the reference map; {worst_m:g} m and more have the darkest colour."
        ),
        panels=[_map_panel(name, errors, box, worst_m) for name, errors in maps],
        legend=[colour_bar(worst_m)],
    )


def colour_bar(worst_m: float) -> Markup:
    """The scale from 0 to `worst_m` metres."""
    palette, step = colours(_COLOURS), 220.0 / _COLOURS
    boxes = [
        element("rect", x=8 + i * step, y=4.0, width=step + 0.3, height=10.0, fill=colour, shape_rendering="crispEdges")
        for i, colour in enumerate(palette)
    ]
    x = Scale(0.0, worst_m, 8.0, 228.0)
    named = [(0.0, "0"), (0.5 * worst_m, f"{0.5 * worst_m:g}"), (worst_m, f"≥ {worst_m:g} m")]
    labels = [text(label, x.at(value), 27.0, anchor="middle", quiet=True) for value, label in named]
    return element(
        "svg", *boxes, *labels, width="270", height="32", viewBox="0 0 270 32", role="img", font_family=FONT,
        aria_label=f"Colour scale of distances from 0 to {worst_m:g} m", xmlns="http://www.w3.org/2000/svg",
    )  # fmt: skip


def colours(count: int) -> list[str]:
    """So many colours from that of no error to that of the largest, as #rrggbb."""
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in _palette(count).tolist()]


def raster(errors: MapErrors, x: Scale, y: Scale, worst_m: float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Picture (H, W): 0 where no point lies, otherwise 1 + the colour of the median distance in the pixel."""
    rows = np.floor(y(errors.points[:, 1])).astype(np.int64)
    columns = np.floor(x(errors.points[:, 0])).astype(np.int64)
    height, width = shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width) & np.isfinite(errors.distances_m)
    pixel, distances = rows[inside] * width + columns[inside], errors.distances_m[inside]
    order = np.lexsort((distances, pixel))
    pixel, distances = pixel[order], distances[order]
    found, first, counts = np.unique(pixel, return_index=True, return_counts=True)
    median = distances[first + (counts - 1) // 2]
    picture = np.zeros(height * width, dtype=np.uint8)
    picture[found] = 1 + np.minimum(median / worst_m * _COLOURS, _COLOURS - 1).astype(np.uint8)
    return picture.reshape(shape)


def _palette(count: int) -> NDArray[np.uint8]:
    return error_colours(np.linspace(_PALEST, 0.0, count), clip_m=1.0)


def _colour_range(maps: Sequence[MapErrors]) -> float:
    """The end of the colour scale: what one point in twenty exceeds in the middling map."""
    finite = [errors.distances_m[np.isfinite(errors.distances_m)] for errors in maps]
    ends = [float(np.percentile(distances, 95.0)) for distances in finite if len(distances)]
    return round_up(float(np.median(ends))) if ends else 1.0


def _box(maps: Sequence[MapErrors]) -> tuple[FloatArray, FloatArray]:
    """Corners of what is shown, the same for all maps; a few stray points do not stretch it."""
    corners = [np.percentile(errors.points[:, :2], (0.2, 99.8), axis=0) for errors in maps]
    low, high = np.median([c[0] for c in corners], axis=0), np.median([c[1] for c in corners], axis=0)
    return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


def _map_panel(name: str, errors: MapErrors, box: tuple[FloatArray, FloatArray], worst_m: float) -> Markup:
    (x_low, x_high), (y_low, y_high) = (widened(float(box[0][a]), float(box[1][a]), 0.03, 0.5) for a in (0, 1))
    width = draw_width(_WIDTH)
    height = float(np.clip(width * (y_high - y_low) / (x_high - x_low), _FLATTEST, _TALLEST))
    per_m = min(width / (x_high - x_low), height / (y_high - y_low))
    x_mid, y_mid, half_x, half_y = (x_low + x_high) / 2, (y_low + y_high) / 2, width / per_m / 2, height / per_m / 2
    x = Scale(x_mid - half_x, x_mid + half_x, 0.0, width)
    y = Scale(y_mid - half_y, y_mid + half_y, height, 0.0)
    shape = (int(height * _OVERSAMPLING), int(width * _OVERSAMPLING))
    fine_x, fine_y = Scale(x.low, x.high, 0.0, float(shape[1])), Scale(y.low, y.high, float(shape[0]), 0.0)
    picture = raster(errors, fine_x, fine_y, worst_m, shape)
    png = indexed_png(picture, np.concatenate([[[255, 255, 255]], _palette(_COLOURS)]).astype(np.uint8))
    image = element("image", href=data_uri(png), x=0.0, y=0.0, width=width, height=height, preserveAspectRatio="none")
    ground = element("rect", width=width, height=height, fill="#ffffff", class_="ground")
    x_values, y_values = ticks(x.low, x.high, 6), ticks(y.low, y.high, max(2, int(height // 60)))
    panel = Panel(
        name,
        f"Map of {name} from above, coloured by its distance from the reference map.",
        width,
        height,
        "x [m]",
        scale_ticks(x, x_values.tolist(), tick_texts(x_values)),
        scale_ticks(y, y_values.tolist(), tick_texts(y_values)),
        grid="",
    )
    return draw_panel(panel, [ground, image])
