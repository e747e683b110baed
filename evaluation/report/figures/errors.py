"""Absolute errors over the distance travelled, and their components along the axes of the LiDAR."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.comparison.comparison import MethodResult, SequenceComparison
from lidarslam.evaluation.report.bulk import in_bulk, leaves
from lidarslam.evaluation.report.figures.figure import Figure, Panel, Styles, line_trace, thin_curve
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics

ALIGNED = {
    "se3": "after SE(3) alignment",
    "first_pose": "after alignment of the first poses",
    "none": "without alignment",
}
_COMPONENTS = ("x, forward [m]", "y, left [m]", "z, up [m]", "roll [°]", "pitch [°]", "yaw [°]")
# Largest errors that differ by this factor cannot be read on one linear axis. A method whose errors are so much larger
# than the others' leaves the picture, which ends at this multiple of the largest that stays.
_LOG_RATIO = 10.0
_BEYOND = 1.5

Measured = Sequence[tuple[MethodResult, TrajectoryMetrics]]


def error_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Position and orientation error over the distance travelled; None without a reference."""
    measured = measured_methods(sequence)
    if not measured:
        return None
    errors = [metrics.absolute_errors() for _, metrics in measured]
    curves = {
        "Position error [m]": [metres for metres, _ in errors],
        "Orientation error [°]": [np.rad2deg(rad) for _, rad in errors],
    }
    panels = [_panel(title, measured, of, styles, signed=False) for title, of in curves.items()]
    caption = (
        f"Absolute trajectory error, {aligned_how(measured)}: distance between the estimated and the reference position"
        f" and angle between the orientations, over the distance travelled along the reference"
        f" ({sequence.reference_name}). Crosses mark scans on which tracking was lost."
        f"{_leaving(measured, curves, signed=False)}"
    )
    return Figure("Absolute errors", caption, panels, [method.name for method, _ in measured])


def deviation_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Components of the error along and about the axes of the reference's LiDAR; None without a reference."""
    measured = measured_methods(sequence)
    if not measured:
        return None
    found = [np.hstack(metrics.deviations()) for _, metrics in measured]
    curves = {title: [components[:, axis] for components in found] for axis, title in enumerate(_COMPONENTS)}
    panels = [_panel(title, measured, of, styles, signed=True) for title, of in curves.items()]
    caption = (
        "Pose of the estimate in the frame of the reference's LiDAR (x forward, y left, z up),"
        f" {aligned_how(measured)}, over the distance travelled along the reference."
        f"{_leaving(measured, curves, signed=True)}"
    )
    return Figure("Error components", caption, panels, [method.name for method, _ in measured], columns=3)


def measured_methods(sequence: SequenceComparison) -> list[tuple[MethodResult, TrajectoryMetrics]]:
    """The methods that were compared with the reference."""
    return [(method, method.metrics) for method in sequence.methods if method.metrics is not None]


def aligned_how(measured: Measured) -> str:
    """How the estimates were brought to the reference's world."""
    return " or ".join(dict.fromkeys(ALIGNED[metrics.alignment] for _, metrics in measured))


def needs_log(curves: Sequence[FloatArray]) -> bool:
    """Whether the largest values of positive curves differ so much that a linear axis would hide the smaller ones."""
    largest = [float(np.nanmax(curve)) for curve in curves if np.isfinite(curve).any()]
    return bool(largest) and max(largest) > _LOG_RATIO * max(min(largest), 1e-9)


def _panel(title: str, measured: Measured, curves: Sequence[FloatArray], styles: Styles, signed: bool) -> Panel:
    traces: list[Any] = []
    for (method, metrics), curve in zip(measured, curves, strict=True):
        travelled, rows, style = metrics.association.reference.distances, thin_curve(curve), styles[method.name]
        hover = "%{y:.3f}"
        traces.append(line_trace(method.name, style, travelled[rows], curve[rows], hovertemplate=hover))
        lost = np.zeros(0, dtype=np.intp)
        if method.lost is not None:
            lost = np.flatnonzero(method.lost[metrics.association.rows])
        if len(lost) and not signed:
            lost = lost[thin_curve(curve[lost])]
            cross = {"symbol": "x", "size": 5, "color": style.colour}
            more = {"mode": "markers", "marker": cross, "hoverinfo": "skip"}
            traces.append(line_trace(method.name, style, travelled[lost], curve[lost], **more))
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": "distance travelled [m]"}, "hoverformat": ".1f"},
        "yaxis": {} if signed else {"rangemode": "tozero"},
        "hovermode": "x unified",
    }
    kept, log = _kept(curves, signed)
    if not all(kept):
        end = _BEYOND * max(_largest(curve) for curve, is_kept in zip(curves, kept, strict=True) if is_kept)
        layout["yaxis"]["range"] = [-end if signed else 0.0, end]
    return Panel(title, traces, layout, 190 if signed else 270, None if signed else log)


def _kept(curves: Sequence[FloatArray], signed: bool) -> tuple[list[bool], bool]:
    """Which curves a panel holds, and whether its axis is logarithmic, which holds them all."""
    largest = [_largest(curve) for curve in curves]
    kept = in_bulk(largest, _LOG_RATIO)
    log = not signed and needs_log([curve for curve, is_kept in zip(curves, kept, strict=True) if is_kept])
    shows_all = log or not any(size for size, is_kept in zip(largest, kept, strict=True) if is_kept)
    return [True] * len(kept) if shows_all else kept, log


def _largest(curve: FloatArray) -> float:
    return float(np.nanmax(np.abs(curve), initial=0.0))


def _leaving(measured: Measured, panels: Mapping[str, Sequence[FloatArray]], signed: bool) -> str:
    """The sentences about methods that leave a panel, by the panels' titles, which end with the unit."""
    far: dict[str, dict[str, float]] = {}
    for title, curves in panels.items():
        unit = {"[m]": " m", "[°]": "°"}[title.split()[-1]]
        for (method, _), curve, is_kept in zip(measured, curves, _kept(curves, signed)[0], strict=True):
            if not is_kept:
                of = far.setdefault(method.name, {})
                of[unit] = max(of.get(unit, 0.0), _largest(curve))
    notes = [f" {leaves(name, of)}." for name, of in far.items()]
    return "".join([*notes, " A double click shows all."] if notes else notes)
