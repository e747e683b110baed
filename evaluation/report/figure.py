"""A figure: panels drawn by plotly, a legend, and a caption; a method has one colour and dash in all of them."""

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray
from plotly.io.json import to_json_plotly

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.comparison.comparison import printable

# After Okabe and Ito (blue, vermilion, green, purple), then four more; contrast of 3 or more on white and on dark.
_COLOURS = ("#1a80c4", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9bd1", "#aa3377", "#7f7f7f")
# Eight colours and five dashes are 40 combinations.
_DASHES = {"solid": "", "dash": "7 3", "dot": "2 2", "dashdot": "9 3 2 3", "longdash": "13 4"}
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x")
_LONGEST_NAME = 40
MOST_POINTS = 1000

EQUAL_AXES: Mapping[str, Any] = {
    "xaxis": {"automargin": False},
    "yaxis": {"automargin": False, "scaleanchor": "x"},
    "margin": {"l": 52, "r": 8, "t": 6, "b": 40},
}
"""Layout of axes with one scale, whose margins plotly cannot find by itself."""


@dataclass(frozen=True)
class Style:
    """Line style of a method."""

    order: int  # of the method in the report, from 0

    @property
    def key(self) -> str:
        """Identifies the method's traces in all figures."""
        return f"m{self.order}"

    @property
    def colour(self) -> str:
        """As #rrggbb."""
        return _COLOURS[self.order % len(_COLOURS)]

    @property
    def dash(self) -> str:
        """SVG's stroke-dasharray; empty for a solid line."""
        return list(_DASHES.values())[self.order % len(_DASHES)]

    @property
    def line(self) -> dict[str, Any]:
        """The line in plotly's terms."""
        return {"color": self.colour, "dash": list(_DASHES)[self.order % len(_DASHES)], "width": 1.8}

    @property
    def marker(self) -> dict[str, Any]:
        """The marker in plotly's terms."""
        return {"color": self.colour, "symbol": _SYMBOLS[self.order % len(_SYMBOLS)], "size": 7}


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot."""

    title: str  # quantity and unit
    traces: Sequence[Any]  # plotly's
    layout: Mapping[str, Any]  # differences from the page's layout
    height: int  # in pixels; the width is the page's
    log: bool | None = None  # whether the vertical axis starts logarithmic; None where it cannot be

    @property
    def json(self) -> str:
        """Data and layout; safe in a script element, as <, > and / are written as escapes."""
        layout = {**self.layout, "template": "none"}
        if self.log:
            layout["yaxis"] = {**layout.get("yaxis", {}), "type": "log"}
        return str(to_json_plotly(go.Figure(list(self.traces), layout)))


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels under one number."""

    title: str  # a few words, the beginning of the caption
    caption: str  # content, units and frames
    panels: Sequence[Panel]  # of the same methods
    methods: Sequence[str] = ()  # entries of the legend
    reference: str = ""  # name of the reference in the legend; empty where it is not drawn
    columns: int = 2  # number of panels side by side on a wide page


Styles = Mapping[str, Style]


def method_styles(names: Iterable[str]) -> dict[str, Style]:
    """A style for each name, in order of first appearance."""
    return {name: Style(order) for order, name in enumerate(dict.fromkeys(names))}


def plot_text(text: str) -> str:
    """The text as plotly shows it unchanged, which else interprets some tags; shortened."""
    text = printable(text)
    return html.escape(text if len(text) <= _LONGEST_NAME else f"{text[: _LONGEST_NAME - 1]}…", quote=False)


def line_trace(name: str, style: Style, x: ArrayLike, y: ArrayLike, **more: Any) -> Any:
    """A method's curve or markers; NaN interrupts it, a list holds categories."""
    given = {"mode": "lines", "line": style.line, "legendgroup": style.key, **more}
    x, y = (values if isinstance(values, list) else np.asarray(values, np.float32) for values in (x, y))
    return go.Scatter(x=x, y=y, name=plot_text(name), **given)


def thin_curve(y: FloatArray) -> NDArray[np.intp]:
    """Rows of a curve (N,), at most `MOST_POINTS`: lowest and highest of each of equal pieces, so that peaks stay."""
    if len(y) <= MOST_POINTS:
        return np.arange(len(y))
    piece = np.arange(len(y)) * (MOST_POINTS // 2 - 1) // len(y)
    order = np.lexsort((y, piece))
    ends = np.flatnonzero(np.diff(piece[order])) + 1
    return np.unique(np.r_[0, len(y) - 1, order[np.r_[0, ends]], order[np.r_[ends - 1, len(y) - 1]]])
