"""Drift over the length of segments, and over their speed."""

from collections.abc import Mapping, Sequence

import numpy as np

from lidarslam.evaluation.comparison.comparison import SequenceComparison
from lidarslam.evaluation.report.figures.errors import measured_methods, needs_log
from lidarslam.evaluation.report.figures.figure import Figure, Panel, Styles, line_trace
from lidarslam.evaluation.trajectory.drift import KITTI_LENGTHS_M, SHORT_LENGTHS_M, Drift

_LENGTH = "segment length [m]"
Parts = Sequence[tuple[str, Mapping[int, Drift | None]]]


def length_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Drift by segment length, KITTI's and the short one; None when no trajectory is long enough for either."""
    measured = measured_methods(sequence)
    kitti = [(m.name, metrics.kitti.by_length) for m, metrics in measured if metrics.kitti is not None]
    short = [(method.name, metrics.segments) for method, metrics in measured]
    panels = _panels(kitti, KITTI_LENGTHS_M, _LENGTH, 100, styles, ", 100 to 800 m")
    panels += _panels(short, SHORT_LENGTHS_M, _LENGTH, 10, styles, ", 5 to 100 m")
    if not panels:
        return None
    caption = (
        "Mean translation error in percent of the segment length and mean rotation error per 100 m (segments of 100 to"
        " 800 m, as the KITTI development kit computes it) or per 10 m (segments of 5 to 100 m)."
    )
    return Figure("Drift by segment length", caption, panels, [method.name for method, _ in measured])


def speed_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """KITTI's drift by the speed over the segment; None when no segment of 100 m exists."""
    kitti = [(m.name, metrics.kitti.by_speed) for m, metrics in measured_methods(sequence) if metrics.kitti is not None]
    speeds = sorted({mps for _, by_speed in kitti for mps, drift in by_speed.items() if drift is not None})
    panels = _panels(kitti, speeds, "speed over the segment [m/s]", 100, styles, "")
    if not panels:
        return None
    caption = "Mean errors over all segments of 100 to 800 m that were driven within 2 m/s of the speed."
    return Figure("Drift by speed", caption, panels, [name for name, _ in kitti])


def _panels(parts: Parts, places: Sequence[int], x_label: str, per_m: int, styles: Styles, over: str) -> list[Panel]:
    """Translation and rotation over the lengths or speeds at which any method has a drift."""
    reached = [place for place in places if any(by_place.get(place) for _, by_place in parts)]
    if not reached:
        return []
    translation, rotation = {}, {}
    for name, by_place in parts:
        drifts = [by_place.get(place) for place in reached]
        translation[name] = np.array([drift.translation_percent if drift else np.nan for drift in drifts])
        rotation[name] = np.array([drift.rotation_deg_per_m * per_m if drift else np.nan for drift in drifts])
    layout = {
        "xaxis": {"title": {"text": x_label}, "type": "category"},
        "yaxis": {"rangemode": "tozero"},
        "hovermode": "x unified",
    }
    panels = []
    titles = (f"Translation drift{over} [%]", f"Rotation drift{over} [° per {per_m} m]")
    for title, curves in zip(titles, (translation, rotation), strict=True):
        traces = [
            line_trace(
                name, styles[name], [*map(str, reached)], curve,
                mode="lines+markers", marker=styles[name].marker, hovertemplate="%{y:.3f}",
            )
            for name, curve in curves.items()
        ]  # fmt: skip
        panels.append(Panel(title, traces, layout, 250, needs_log(list(curves.values()))))
    return panels
