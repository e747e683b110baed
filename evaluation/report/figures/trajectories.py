"""Trajectories from above and from both sides, in the reference's world."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.evaluation.comparison.comparison import MethodResult, SequenceComparison
from lidarslam.evaluation.report.bulk import beyond_m, leaves, paths_in_bulk
from lidarslam.evaluation.report.figures.errors import ALIGNED
from lidarslam.evaluation.report.figures.figure import (
    EQUAL_AXES,
    MOST_POINTS,
    Figure,
    Panel,
    Styles,
    line_trace,
    plot_text,
)
from lidarslam.evaluation.trajectory.alignment import align

_NOMINAL_WIDTH, _LOWEST, _TALLEST, _SIDE_HEIGHT = 500.0, 240.0, 480.0, 210
# A view that a path leaves ends at this share of its size beyond the others.
_BEYOND = 0.1
_LEAST_HEIGHT_RANGE_M = 1.0
# A straight road seen along its direction is a point.
_LEAST_SIDE = 0.25
_REFERENCE_LINE = {"color": "#9a9a9a", "width": 5}


def trajectory_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """All views; None when no method has a trajectory."""
    paths = {method.name: path for method in sequence.methods if (path := _aligned(method, sequence)) is not None}
    if not paths:
        return None
    reference = _matched_reference(sequence)
    low, high = _view(list(paths.values()), reference)
    extent = np.maximum(high - low, 1.0)
    views = [(0, 1)] + [(axis, 2) for axis in (0, 1) if extent[axis] >= _LEAST_SIDE * extent[:2].max()]
    panels = []
    for across, up in views:
        title = f"{'Top' if up == 1 else 'Side'} view: {'xyz'[up]} over {'xyz'[across]} [m]"
        traces = _traces(sequence, paths, reference, styles, (across, up))
        given = EQUAL_AXES if up == 1 else {"xaxis": {}, "yaxis": {}}
        layout = {
            **given,
            "xaxis": {**given["xaxis"], "title": {"text": f"{'xyz'[across]} [m]"}, "range": _range(low, high, across)},
            "yaxis": {**given["yaxis"], "range": _range(low, high, up)},
            "hovermode": "closest",
        }
        height = int(np.clip(_NOMINAL_WIDTH * extent[1] / extent[0], _LOWEST, _TALLEST)) if up == 1 else _SIDE_HEIGHT
        panels.append(Panel(title, traces, layout, height))
    name = "" if reference is None else sequence.reference_name
    return Figure("Trajectories", _caption(sequence, paths, low, high), panels, list(paths), name)


def _aligned(method: MethodResult, sequence: SequenceComparison) -> FloatArray | None:
    """Positions (N, 3) in the reference's world: aligned as for the ATE, else by the first pose, or relative to it."""
    if method.trajectory is None or not len(method.trajectory):
        return None
    if method.metrics is not None:
        T_reference_estimate = method.metrics.T_reference_estimate
    elif sequence.reference is not None and len(sequence.reference):
        first = slice(0, 1)
        T_reference_estimate = align(method.trajectory.select(first), sequence.reference.select(first), "first_pose")
    else:
        T_reference_estimate = inverse(method.trajectory.T_world_lidar[0])
    return method.trajectory.transformed(T_reference_estimate).positions


def _matched_reference(sequence: SequenceComparison) -> FloatArray | None:
    """Positions of the reference from the first to the last instant of any method's trajectory."""
    if sequence.reference is None or not len(sequence.reference):
        return None
    stamps = sequence.reference.stamps
    spans = [m.trajectory.stamps[[0, -1]] for m in sequence.methods if m.trajectory is not None and len(m.trajectory)]
    first, last = np.searchsorted(stamps, [min(s[0] for s in spans), max(s[1] for s in spans)])
    matched = sequence.reference.positions[max(first - 1, 0) : last + 1]
    return matched if len(matched) > 1 else sequence.reference.positions


def _traces(
    sequence: SequenceComparison,
    paths: dict[str, FloatArray],
    reference: FloatArray | None,
    styles: Styles,
    axes: tuple[int, int],
) -> list[Any]:
    traces = []
    if reference is not None:
        rows = _thin(len(reference))
        x, y = (np.float32(reference[rows, axis]) for axis in axes)
        name, line = plot_text(sequence.reference_name), _REFERENCE_LINE
        traces.append(go.Scatter(x=x, y=y, name=name, mode="lines", line=line, legendgroup="reference"))
    for method in sequence.methods:
        if method.name not in paths:
            continue
        style, path, rows = styles[method.name], paths[method.name], _thin(len(paths[method.name]))
        x, y = path[rows, axes[0]], path[rows, axes[1]]
        hover = f"scan %{{customdata}}<br>{'xyz'[axes[0]]} %{{x:.2f}} m, {'xyz'[axes[1]]} %{{y:.2f}} m"
        traces.append(line_trace(method.name, style, x, y, customdata=rows, hovertemplate=hover))
        if method.lost is not None and method.lost.any():
            lost = np.flatnonzero(method.lost)
            lost = lost[_thin(len(lost))]
            cross = {"symbol": "x", "size": 6, "color": style.colour, "line": {"width": 0}}
            more = {"mode": "markers", "marker": cross, "customdata": lost, "hovertemplate": "scan %{customdata}: lost"}
            traces.append(line_trace(method.name, style, path[lost, axes[0]], path[lost, axes[1]], **more))
    start = next(iter(paths.values())) if reference is None else reference
    ring = {"symbol": "circle-open", "size": 11, "color": "#8a8a8a", "line": {"width": 2}}
    first = [start[:1, axis] for axis in axes]
    return [*traces, go.Scatter(x=first[0], y=first[1], mode="markers", marker=ring, name="start", hoverinfo="name")]


def _thin(count: int) -> np.ndarray[tuple[int], np.dtype[np.int32]]:
    """Rows of evenly spaced poses."""
    return np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int32)


def _view(paths: Sequence[FloatArray], reference: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of the first view: all paths but those that diverge."""
    kept = [path for path, inside in zip(paths, paths_in_bulk(paths, reference), strict=True) if inside]
    points = np.concatenate([*kept, *([] if reference is None else [reference])])
    low, high = points.min(axis=0), points.max(axis=0)
    short = np.maximum(_LEAST_HEIGHT_RANGE_M - (high - low), 0.0) / 2.0
    beyond = _BEYOND * (high - low) if len(kept) < len(paths) else 0.0
    return low - short - beyond, high + short + beyond


def _range(low: FloatArray, high: FloatArray, axis: int) -> list[float]:
    margin = 0.05 * (high[axis] - low[axis])
    return [float(low[axis] - margin), float(high[axis] + margin)]


def _caption(sequence: SequenceComparison, paths: dict[str, FloatArray], low: FloatArray, high: FloatArray) -> str:
    measured = [method.metrics for method in sequence.methods if method.metrics is not None]
    unmeasured = [m.name for m in sequence.methods if m.trajectory is not None and m.metrics is None]
    if sequence.reference is None:
        frame = f"{'each ' if len(paths) > 1 else ''}in the frame of its first pose, as there is no reference"
    elif measured:
        frame = " or ".join(dict.fromkeys(ALIGNED[metrics.alignment] for metrics in measured))
        frame += f"; aligned by the first pose only: {', '.join(unmeasured)}" if unmeasured else ""
    else:
        frame = "aligned with the reference by the first pose"
    outside = {name: far for name, path in paths.items() if (far := beyond_m(path, low, high)) > 0.0}
    cut = "".join(f" {leaves(name, {' m': far})} outside." for name, far in outside.items())
    cut += " A double click shows all." if outside else ""
    what = "Paths of all methods" if len(paths) > 1 else "Path"
    return (
        f"{what}, {frame}. The ring marks the start, crosses mark scans on which tracking was lost."
        f" The axes of the top view have one scale, those of the side views have not.{cut}"
    )
