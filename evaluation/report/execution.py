"""Figures of execution: time and memory, registration of each scan, and tracking status over the recording."""

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np

from lidarslam.core.tracking import Status
from lidarslam.evaluation.comparison.comparison import ScanSeries, SequenceComparison, lost_intervals, times_note
from lidarslam.evaluation.report.figure import (
    Figure,
    Panel,
    Styles,
    bar_panel,
    bar_trace,
    line_trace,
    plot_text,
    thin_curve,
)

# A dashed line at the scan period is drawn up to this multiple of the longest bar.
_PERIOD_IN_REACH = 2.5
_QUANTITIES = (
    ("residual_m", "Residual [m]", "%{y:.4f}"),
    ("inlier_ratio", "Inlier ratio", "%{y:.3f}"),
    ("points_used", "Points used", "%{y:,.0f}"),
)
_BANDS = {Status.DEGRADED: "#e69f00", Status.LOST: "#d4003c"}
_MOST_BANDS = 200
_HEIGHT = 210
# The shortest interval stays visible.
_LEAST_SHARE = 0.003


def resources_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Elapsed time per scan, time of each stage, and memory; None when nothing was measured."""
    time = {m.name: m.elapsed_ms_per_scan for m in sequence.methods if m.elapsed_ms_per_scan is not None}
    memory = {m.name: m.peak_rss_mb / 1000.0 for m in sequence.methods if m.peak_rss_mb is not None}
    panels = [_time_panel(sequence, time, styles)] if time else []
    panels += [stages] if (stages := _stage_panel(sequence, styles)) is not None else []
    panels += [bar_panel("Peak memory [GB]", "GB", memory, styles)] if memory else []
    if not panels:
        return None
    caption = (
        "Elapsed time of all scans over their number; a method left of the dashed line keeps up with the sensor. Stages"
        " run in parallel, so that their times need not add up; stages that did not run are left out. Memory is the"
        f" peak of the process and its children. {times_note(sequence.methods)}"
    )
    names = [method.name for method in sequence.methods if method.name in time or method.name in memory]
    return Figure("Time and memory", caption, panels, names, columns=3)


def _time_panel(sequence: SequenceComparison, time: dict[str, float], styles: Styles) -> Panel:
    panel = bar_panel("Elapsed time per scan [ms]", "ms", time, styles)
    stamps = [m.trajectory.stamps for m in sequence.methods if m.trajectory is not None and len(m.trajectory) > 1]
    period_ms = 1e3 * float(np.median(np.diff(stamps[0]))) if stamps else np.inf
    if period_ms > _PERIOD_IN_REACH * max(time.values()):
        return panel
    line = {"type": "line", "xref": "x", "yref": "paper", "x0": period_ms, "x1": period_ms, "y0": 0, "y1": 1}
    shape = {**line, "line": {"dash": "dash", "width": 1, "color": "#8a8a8a"}}
    return Panel(panel.title, panel.traces, {**panel.layout, "shapes": [shape]}, panel.height)


def _stage_panel(sequence: SequenceComparison, styles: Styles) -> Panel | None:
    found = dict.fromkeys(stage for method in sequence.methods for stage, ms in method.stage_ms.items() if ms > 0.0)
    stages, bars = list(found), []
    for m in sequence.methods:
        if any(m.stage_ms.values()):
            ms = [m.stage_ms.get(stage) or None for stage in stages]
            bars.append(bar_trace(m.name, styles[m.name], x=ms, y=stages, hovertemplate="%{x:.2f} ms"))
    layout = {"xaxis": {"title": {"text": "[ms]"}}, "yaxis": {"autorange": "reversed"}, "hovermode": "closest"}
    height = 70 + len(stages) * (8 + 8 * len(bars))
    return Panel("Median time of each stage [ms]", bars, layout, height) if stages else None


def scan_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Residual, inlier ratio and points of each scan; None when no method kept them."""
    kept = [(method, method.series) for method in sequence.methods if method.series is not None]
    bands = list(_bands(kept[0][1])) if len(kept) == 1 else []
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


def tracking_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """A strip for each method; None when tracking was never lost."""
    followed = [(m, m.trajectory) for m in sequence.methods if m.trajectory is not None and len(m.trajectory)]
    if not any(method.lost_scans for method, _ in followed):
        return None
    begin_s = min(float(trajectory.stamps[0]) for _, trajectory in followed)
    span_s = max(float(trajectory.stamps[-1]) for _, trajectory in followed) - begin_s
    traces = []
    for method, trajectory in followed:
        start_s = float(trajectory.stamps[0]) - begin_s
        bars = [(0.0, trajectory.duration_s, 0.25, f"{trajectory.duration_s:.1f} s")]
        bars += [
            (i.begin_s, max(i.end_s - i.begin_s, _LEAST_SHARE * span_s), 0.8, f"lost: {i.scans} scans, {i.reason}")
            for i in lost_intervals(method)
        ]
        begins, lengths, widths, texts = zip(*bars, strict=True)
        traces.append(
            bar_trace(
                method.name, styles[method.name], base=[start_s + begin for begin in begins], x=lengths,
                y=[plot_text(method.name)] * len(bars), width=widths, customdata=[plot_text(text) for text in texts],
                hovertemplate="%{base:.1f} s: %{customdata}",
            )
        )  # fmt: skip
    layout = {
        "xaxis": {"title": {"text": "time since the first scan [s]"}, "range": [0.0, span_s]},
        "yaxis": {"autorange": "reversed"},
        "hovermode": "closest",
        "barmode": "overlay",
    }
    panel = Panel("Tracking", traces, layout, 70 + 30 * len(followed))
    caption = "A thin strip where scans were tracked, a block where tracking was lost, nothing where poses end."
    return Figure("Tracking status", caption, [panel], [method.name for method, _ in followed], columns=1)
