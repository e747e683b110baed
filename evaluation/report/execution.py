"""The figure of the registration of each scan."""

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np

from lidarslam.core.tracking import Status
from lidarslam.evaluation.comparison.comparison import ScanSeries, SequenceComparison
from lidarslam.evaluation.report.figure import Figure, Panel, Styles, line_trace, thin_curve

_QUANTITIES = (
    ("residual_m", "Residual [m]", "%{y:.4f}"),
    ("inlier_ratio", "Inlier ratio", "%{y:.3f}"),
    ("points_used", "Points used", "%{y:,.0f}"),
)
_BANDS = {Status.DEGRADED: "#e69f00", Status.LOST: "#d4003c"}
_MOST_BANDS = 200
_HEIGHT = 210


def scan_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Residual, inlier ratio and points of each scan of a run; None when they were not kept, as in a comparison."""
    kept = [(method.name, method.series) for method in sequence.methods if method.series is not None]
    if not kept:
        return None
    ((name, series),) = kept
    layout = {
        "xaxis": {"title": {"text": "time since the first scan [s]"}, "hoverformat": ".1f"},
        "yaxis": {"rangemode": "tozero"},
        "hovermode": "x unified",
        "shapes": list(_bands(series)),
    }
    panels = []
    for quantity, title, hover in _QUANTITIES:
        values = getattr(series, quantity)
        if np.isfinite(values).any():
            rows = thin_curve(np.nan_to_num(values))
            trace = line_trace(name, styles[name], series.times_s[rows], values[rows], hovertemplate=hover)
            panels.append(Panel(title, [trace], layout, _HEIGHT))
    caption = (
        "Fit of each scan to the map, or to the previous scan without a map: median distance of the matched points from"
        " their surfaces, share of inliers, and points used. In the bands tracking was degraded (orange) or lost (red)."
    )
    return Figure("Registration over time", caption, panels, [name], columns=3) if panels else None


def _bands(series: ScanSeries) -> Iterator[dict[str, Any]]:
    """The stretches of time on which tracking was degraded or lost, as plotly's shapes."""
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
