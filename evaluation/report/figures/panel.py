"""One panel: a title that says quantity and unit, an area to draw in, ticks and grid lines around it."""

from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.report.figures.scale import Scale
from evaluation.report.markup import NOTHING, Markup, element, escape, join, number
from lidarslam.core.geometry import FloatArray

LEFT, RIGHT, TOP, BOTTOM = 48.0, 14.0, 30.0, 36.0
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
_INK, _GREY, _GRID = "#1a1a1a", "#5c5c5c", "#e4e4e4"

Ticks = Sequence[tuple[float, str]]
"""Places in pixels of the drawing area, and their texts."""


@dataclass(frozen=True)
class Panel:
    """A drawing area with its surroundings; pixels count from its upper left corner.

    Attributes:
        title: quantity and unit, above the vertical axis.
        description: for readers who cannot see the panel.
        width, height: of the drawing area, in pixels.
        x_label: under the horizontal axis.
        x_ticks, y_ticks: along the axes.
        grid: across which axis lines are drawn.
    """

    title: str
    description: str
    width: float
    height: float
    x_label: str
    x_ticks: Ticks
    y_ticks: Ticks
    grid: str = "y"


def draw_width(panel_width: float) -> float:
    """Width of the drawing area in a panel so wide."""
    return panel_width - LEFT - RIGHT


def draw_panel(panel: Panel, content: Sequence[Markup], over: Sequence[Markup] = (), left: float = LEFT) -> Markup:
    """The panel as SVG; `content` is cut off at the area's border, `over` is not."""
    width, height = left + panel.width + RIGHT, TOP + panel.height + BOTTOM
    area = element("svg", *content, width=panel.width, height=panel.height, overflow="hidden", class_="area")
    surroundings = [_grid(panel), area, _axes(panel), *over]
    return element(
        "svg",
        element("desc", escape(panel.description)),
        text(panel.title, 2.0, 15.0, size=12.5, weight="600"),
        element("g", *surroundings, transform=f"translate({number(left)},{number(TOP)})"),
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {number(width)} {number(height)}",
        role="img",
        aria_label=panel.title,
        class_="panel",
        font_family=FONT,
    )


def text(
    content: str, x: float, y: float, size: float = 11.0, anchor: str | None = None, weight: str | None = None,
    quiet: bool = False,
) -> Markup:  # fmt: skip
    """A line of text; `quiet` sets it in grey."""
    return element(
        "text",
        escape(content),
        x=x,
        y=y,
        font_size=size,
        text_anchor=anchor,
        font_weight=weight,
        fill=_GREY if quiet else _INK,
        class_="quiet" if quiet else "ink",
    )


def shortened(name: str, most: int) -> str:
    """The name, cut to so many characters."""
    return name if len(name) <= most else name[: most - 1] + "…"


def scale_ticks(scale: Scale, values: Sequence[float], texts: Sequence[str]) -> Ticks:
    """Ticks of a scale at values."""
    return [(scale.at(value), label) for value, label in zip(values, texts, strict=True)]


def polyline(x: FloatArray, y: FloatArray) -> str:
    """SVG path data through points in pixels, one decimal each."""
    points = [f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    distinct = [point for i, point in enumerate(points) if not i or point != points[i - 1]]
    return "M" + "L".join(distinct) if distinct else ""


def _grid(panel: Panel) -> Markup:
    across = [f"M0,{number(y)}H{number(panel.width)}" for y, _ in panel.y_ticks if "y" in panel.grid]
    down = [f"M{number(x)},0V{number(panel.height)}" for x, _ in panel.x_ticks if "x" in panel.grid]
    if not across and not down:
        return NOTHING
    return element("path", d="".join(across + down), stroke=_GRID, class_="grid", fill="none")


def _axes(panel: Panel) -> Markup:
    base = panel.height
    marks = "".join(f"M{number(x)},{number(base)}v4" for x, _ in panel.x_ticks)
    line = element(
        "path", d=f"M0,{number(base)}H{number(panel.width)}{marks}", stroke=_GREY, class_="axis", fill="none"
    )
    below = [text(label, x, base + 16.0, anchor="middle", quiet=True) for x, label in panel.x_ticks]
    beside = [text(label, -7.0, y + 3.8, anchor="end", quiet=True) for y, label in panel.y_ticks]
    name = text(panel.x_label, panel.width / 2.0, base + 31.0, anchor="middle", quiet=True)
    return join([line, *below, *beside, name])
