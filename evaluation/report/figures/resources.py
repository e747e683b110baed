"""Time and memory of each method."""

import numpy as np
import plotly.graph_objects as go

from lidarslam.evaluation.comparison.comparison import SequenceComparison
from lidarslam.evaluation.comparison.quantities import times_note
from lidarslam.evaluation.report.figures.figure import Figure, Panel, Styles, bar_panel, plot_text

# A dashed line at the scan period is drawn up to this multiple of the longest bar.
_PERIOD_IN_REACH = 2.5


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
