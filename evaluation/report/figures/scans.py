"""Quality of the registration of each scan over time."""

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np

from lidarslam.core.tracking import Status
from lidarslam.evaluation.comparison.comparison import MethodResult, SequenceComparison
from lidarslam.evaluation.report.figures.figure import Figure, Panel, Styles, line_trace, thin_curve

_QUANTITIES = (
    ("residual_m", "Residual [m]", "%{y:.4f}"),
    ("inlier_ratio", "Inlier ratio", "%{y:.3f}"),
    ("points_used", "Points used", "%{y:,.0f}"),
)
_BANDS = {Status.DEGRADED: "#e69f00", Status.LOST: "#d4003c"}
_MOST_BANDS = 200
_HEIGHT = 210


def scan_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Residual, inlier ratio and points of each scan; None when no method kept them."""
    kept = [(method, method.series) for method in sequence.methods if method.series is not None]
    if not kept:
        return None
    bands = list(_bands(kept[0][0])) if len(kept) == 1 else []
    panels = []
    for name, title, hover in _QUANTITIES:
        traces: list[Any] = []
        for method, series in kept:
            values = getattr(series, name)
            rows, style = thin_curve(np.nan_to_num(values)), styles[method.name]
            if np.isfinite(values).any():
                traces.append(line_trace(method.name, style, series.times_s[rows], values[rows], hovertemplate=hover))
        layout = {
            "xaxis": {"title": {"text": "time since the first scan [s]"}, "hoverformat": ".1f"},
            "yaxis": {"rangemode": "tozero"},
            "hovermode": "x unified",
            "shapes": bands,
        }
        if traces:
            panels.append(Panel(title, traces, layout, _HEIGHT))
    if not panels:
        return None
    caption = (
        "Fit of each scan to the map, or to the previous scan without a map: median distance of the matched points from"
        " their surfaces, share of inliers, and points used. In the bands tracking was degraded (orange) or lost (red)."
    )
    return Figure("Registration over time", caption, panels, [method.name for method, _ in kept], columns=3)


def _bands(method: MethodResult) -> Iterator[dict[str, Any]]:
    """The stretches of time on which tracking was degraded or lost, as plotly's shapes."""
    series = method.series
    if series is None:
        return
    ends_s = np.append(series.times_s[1:], series.times_s[-1:])
    stretches = [
        (status, [row for row, _ in group])
        for status, group in groupby(enumerate(series.statuses), key=lambda entry: entry[1])
        if status in _BANDS
    ]
    for status, rows in stretches[:_MOST_BANDS]:
        place = {"xref": "x", "x0": series.times_s[rows[0]], "x1": ends_s[rows[-1]], "yref": "paper", "y0": 0, "y1": 1}
        look = {"fillcolor": _BANDS[status], "opacity": 0.3, "line": {"width": 0}, "layer": "below"}
        yield {"type": "rect", **place, **look}
