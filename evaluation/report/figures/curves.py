"""Panels of curves, one a method, over a common horizontal axis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evaluation.report.figures.figure import lost_cross
from evaluation.report.figures.palette import Style, marker
from evaluation.report.figures.panel import Panel, draw_panel, draw_width, polyline, scale_ticks, shortened, text
from evaluation.report.figures.scale import Scale, tick_texts, ticks, widened
from evaluation.report.figures.thinning import thin_curve
from evaluation.report.markup import Markup, element, escape
from lidarslam.core.geometry import FloatArray

_MARKERS_ON_A_CURVE = 5
# A curve that reaches this many times farther than all smaller ones leaves the picture, so that those stay readable.
_RUNAWAY = 8.0
_SHORTEST_VISIT = 0.015


@dataclass(frozen=True, eq=False)
class Curve:
    """A method's curve.

    Attributes:
        name: of the method.
        style: of the method.
        x, y: (N,) x rising; where y is not finite the curve is interrupted.
        lost_x: where lost stretches begin.
    """

    name: str
    style: Style
    x: FloatArray
    y: FloatArray
    lost_x: FloatArray | Sequence[float] = ()


def curve_panel(
    title: str,
    x_label: str,
    curves: Sequence[Curve],
    width: float = 540.0,
    height: float = 230.0,
    categories: Sequence[str] | None = None,
) -> Markup:
    """A panel of curves; with `categories`, x counts these from 0 and every point gets its marker."""
    area_width = draw_width(width)
    x = _x_scale(curves, area_width, categories)
    (low, high), runaways = reach(curves)
    y = Scale(low, high, height, 0.0)
    x_values, labels = _x_ticks(x, categories, area_width)
    y_values = ticks(low, high, max(3, round(height / 44)))
    panel = Panel(
        title,
        f"Curves of {', '.join(curve.name for curve in curves) or 'no method'} over {x_label}.",
        area_width,
        height,
        x_label,
        scale_ticks(x, x_values, labels),
        scale_ticks(y, y_values.tolist(), tick_texts(y_values)),
    )
    zero = [_zero_line(y.at(0.0), area_width)] if low < 0.0 < high else []
    inside = [_inside(curve, low, high) if curve in runaways else curve for curve in curves]
    drawn = [_draw(curve, x, y, categories is not None, i / max(len(curves), 1)) for i, curve in enumerate(inside)]
    return draw_panel(panel, [*zero, *drawn], _runaway_note(runaways, area_width))


def reach(curves: Sequence[Curve]) -> tuple[tuple[float, float], list[Curve]]:
    """The vertical range of a panel, and the curves that leave it."""
    drawn = [curve for curve in curves if np.isfinite(curve.y).any()]
    by_size = sorted(drawn, key=lambda curve: float(np.nanmax(np.abs(curve.y))))
    inside: list[Curve] = []
    for curve in by_size:
        if inside and np.nanmax(np.abs(curve.y)) > _RUNAWAY * max(np.nanmax(np.abs(inside[-1].y)), 1e-9):
            break
        inside.append(curve)
    low = min((float(np.nanmin(curve.y)) for curve in inside), default=0.0)
    high = max((float(np.nanmax(curve.y)) for curve in inside), default=1.0)
    if low >= 0.0:
        return (0.0, max(1.06 * high, 1e-9)), by_size[len(inside) :]
    return widened(min(low, 0.0), max(high, 0.0), 0.06), by_size[len(inside) :]


def _inside(curve: Curve, low: float, high: float) -> Curve:
    """The curve where it stays in the picture for a while: where it only crosses it, its lines would hide others."""
    inside = (curve.y >= low) & (curve.y <= high)
    borders = np.flatnonzero(np.diff(np.r_[False, inside, False]))
    for first, past in zip(borders[::2], borders[1::2], strict=True):
        inside[first:past] &= curve.x[past - 1] - curve.x[first] >= _SHORTEST_VISIT * (curve.x[-1] - curve.x[0])
    return replace(curve, y=np.where(inside, curve.y, np.nan))


def _x_scale(curves: Sequence[Curve], width: float, categories: Sequence[str] | None) -> Scale:
    if categories is not None:
        return Scale(-0.4, len(categories) - 0.6, 0.0, width)
    farthest = max((float(curve.x[-1]) for curve in curves if len(curve.x)), default=1.0)
    return Scale(0.0, farthest if farthest > 0.0 else 1.0, 0.0, width)


def _x_ticks(x: Scale, categories: Sequence[str] | None, width: float) -> tuple[list[float], Sequence[str]]:
    if categories is not None:
        return [float(place) for place in range(len(categories))], categories
    values = ticks(x.low, x.high, max(3, round(width / 85)))
    return values.tolist(), tick_texts(values)


def _draw(curve: Curve, x: Scale, y: Scale, at_every_point: bool, phase: float) -> Markup:
    finite = np.isfinite(curve.y)
    across, up = x(curve.x), y(np.where(finite, curve.y, 0.0))
    pieces = np.split(np.arange(len(finite)), np.flatnonzero(np.diff(finite)) + 1)
    paths = []
    for rows in pieces:
        if len(rows) and finite[rows[0]]:
            kept = rows[thin_curve(across[rows], up[rows])]
            paths.append(polyline(across[kept], up[kept]))
    line = element(
        "path",
        d="".join(paths),
        fill="none",
        stroke=curve.style.colour,
        stroke_width=1.6,
        stroke_dasharray=curve.style.dash or None,
        stroke_linejoin="round",
        class_=curve.style.stroke_class,
    )
    chosen = np.flatnonzero(finite) if at_every_point else _marker_rows(across, x, finite, phase)
    markers = [marker(curve.style, float(across[i]), float(up[i])) for i in chosen]
    crosses = [lost_cross(x.at(float(place)), y.start - 6.0) for place in curve.lost_x]
    return element("g", element("title", escape(curve.name)), line, *markers, *crosses, class_="curve")


def _marker_rows(across: FloatArray, x: Scale, finite: NDArray[np.bool_], phase: float) -> NDArray[np.intp]:
    """Rows at even distances, a different start for each method so that markers do not cover one another."""
    places = x.start + (np.arange(_MARKERS_ON_A_CURVE) + 0.1 + 0.8 * phase) / _MARKERS_ON_A_CURVE * (x.end - x.start)
    rows = np.searchsorted(across, places)
    rows = np.unique(rows[rows < len(across)])
    return np.asarray(rows[finite[rows]])


def _zero_line(y_px: float, width: float) -> Markup:
    return element("path", d=f"M0,{y_px:.1f}H{width:.1f}", stroke="#8a8a8a", class_="zero", fill="none")


def _runaway_note(runaways: Sequence[Curve], width: float) -> list[Markup]:
    """Says which curves leave the picture and how far they go."""
    if not runaways:
        return []
    names = ", ".join(f"{shortened(curve.name, 22)} reaches {np.nanmax(np.abs(curve.y)):.3g}" for curve in runaways[:3])
    more = f" and {len(runaways) - 3} more" if len(runaways) > 3 else ""
    return [text(f"beyond: {names}{more}", width, -5.0, size=10.0, anchor="end", quiet=True)]
