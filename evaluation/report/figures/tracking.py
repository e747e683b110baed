"""Tracking status of each method over the recording."""

import plotly.graph_objects as go

from lidarslam.evaluation.comparison.comparison import SequenceComparison
from lidarslam.evaluation.comparison.lost import lost_intervals
from lidarslam.evaluation.report.figures.figure import Figure, Panel, Styles, plot_text

# The shortest interval is still seen.
_LEAST_SHARE = 0.003


def tracking_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """A strip for each method; None when tracking was never lost."""
    followed = [(m, m.trajectory) for m in sequence.methods if m.trajectory is not None and len(m.trajectory)]
    if not any(method.lost_scans for method, _ in followed):
        return None
    begin_s = min(float(trajectory.stamps[0]) for _, trajectory in followed)
    span_s = max(float(trajectory.stamps[-1]) for _, trajectory in followed) - begin_s
    traces = []
    for method, trajectory in followed:
        style, name, start_s = styles[method.name], plot_text(method.name), float(trajectory.stamps[0]) - begin_s
        bars = [(0.0, trajectory.duration_s, 0.25, f"{trajectory.duration_s:.1f} s")]
        bars += [
            (i.begin_s, max(i.end_s - i.begin_s, _LEAST_SHARE * span_s), 0.8, f"lost: {i.scans} scans, {i.reason}")
            for i in lost_intervals(method)
        ]
        begins, lengths, widths, texts = zip(*bars, strict=True)
        traces.append(
            go.Bar(
                base=[start_s + begin for begin in begins],
                x=lengths,
                y=[name] * len(bars),
                width=widths,
                customdata=[plot_text(text) for text in texts],
                hovertemplate="%{base:.1f} s: %{customdata}",
                orientation="h",
                name=name,
                legendgroup=style.key,
                marker={"color": style.colour},
            )
        )
    layout = {
        "xaxis": {"title": {"text": "time since the first scan [s]"}, "range": [0.0, span_s]},
        "yaxis": {"autorange": "reversed"},
        "hovermode": "closest",
        "barmode": "overlay",
    }
    panel = Panel("Tracking", traces, layout, 70 + 30 * len(followed))
    caption = "A thin strip where scans were tracked, a block where tracking was lost, nothing where poses end."
    return Figure("Tracking status", caption, [panel], [method.name for method, _ in followed], columns=1)
