"""Time and memory of each method."""

import numpy as np
import plotly.graph_objects as go

from lidarslam.evaluation.comparison.comparison import SequenceComparison
from lidarslam.evaluation.report.figures.figure import Figure, Panel, Styles, bar_panel, plot_text

# A dashed line at the scan period is drawn up to this multiple of the longest bar.
_PERIOD_IN_REACH = 2.5


def resources_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Time a scan, time of each stage, and memory; None when nothing was measured."""
    time = {m.name: m.ms_per_scan_median for m in sequence.methods if m.ms_per_scan_median is not None}
    memory = {m.name: m.peak_rss_mb / 1000.0 for m in sequence.methods if m.peak_rss_mb is not None}
    panels = [_time_panel(sequence, time, styles)] if time else []
    panels += [stages] if (stages := _stage_panel(sequence, styles)) is not None else []
    panels += [bar_panel("Peak memory [GB]", "GB", memory, styles)] if memory else []
    if not panels:
        return None
    caption = (
        "Median wall time from one finished scan to the next, the whisker at its 95th percentile; a method left of the"
        " dashed line keeps up with the sensor. Stages run in parallel, so that their times need not add up; stages"
        " that did not run are left out. Memory is the peak of the process and its children."
    )
    names = [method.name for method in sequence.methods if method.name in time or method.name in memory]
    return Figure("Time and memory", caption, panels, names, columns=3)


def _time_panel(sequence: SequenceComparison, time: dict[str, float], styles: Styles) -> Panel:
    p95 = {method.name: method.ms_per_scan_p95 for method in sequence.methods}
    whiskers = {
        name: {"type": "data", "symmetric": False, "array": [max((p95[name] or ms) - ms, 0.0)], "arrayminus": [0.0]}
        for name, ms in time.items()
    }
    panel = bar_panel("Time a scan [ms]", "ms", time, styles, error_x=whiskers)
    longest_ms = max(p95[name] or ms for name, ms in time.items())
    stamps = [m.trajectory.stamps for m in sequence.methods if m.trajectory is not None and len(m.trajectory) > 1]
    period_ms = 1e3 * float(np.median(np.diff(stamps[0]))) if stamps else np.inf
    if period_ms > _PERIOD_IN_REACH * longest_ms:
        return panel
    line = {"type": "line", "xref": "x", "yref": "paper", "x0": period_ms, "x1": period_ms, "y0": 0, "y1": 1}
    shape = {**line, "line": {"dash": "dash", "width": 1, "color": "#8a8a8a"}}
    return Panel(panel.title, panel.traces, {**panel.layout, "shapes": [shape]}, panel.height)


def _stage_panel(sequence: SequenceComparison, styles: Styles) -> Panel | None:
    stages = [stage for method in sequence.methods for stage, ms in method.stage_ms.items() if ms > 0.0]
    if not stages:
        return None
    bars = [
        go.Bar(
            x=[method.stage_ms.get(stage) or None for stage in dict.fromkeys(stages)],
            y=list(dict.fromkeys(stages)),
            orientation="h",
            name=plot_text(method.name),
            legendgroup=styles[method.name].key,
            marker={"color": styles[method.name].colour},
            hovertemplate="%{x:.2f} ms",
        )
        for method in sequence.methods
        if any(method.stage_ms.values())
    ]
    layout = {"xaxis": {"title": {"text": "[ms]"}}, "yaxis": {"autorange": "reversed"}, "hovermode": "closest"}
    return Panel("Median time of each stage [ms]", bars, layout, 70 + len(set(stages)) * (8 + 8 * len(bars)))
