"""Figures of accuracy: trajectories, absolute errors, drift and map errors of each method."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.evaluation.comparison.comparison import MethodResult, SequenceComparison
from lidarslam.evaluation.map.metrics import CloudErrors
from lidarslam.evaluation.report.drawing import beyond_m, in_bulk, leaves, paths_in_bulk
from lidarslam.evaluation.report.figure import (
    EQUAL_AXES,
    MOST_POINTS,
    Figure,
    Panel,
    Styles,
    line_trace,
    plot_text,
    thin_curve,
)
from lidarslam.evaluation.report.tables import DriftSeries, drift_series
from lidarslam.evaluation.trajectory.alignment import align
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics

_NOMINAL_WIDTH, _LOWEST, _TALLEST, _SIDE_HEIGHT = 500.0, 240.0, 480.0, 210
# A view that a path leaves ends at this share of its size beyond the others.
_BEYOND_VIEW = 0.1
_LEAST_HEIGHT_RANGE_M = 1.0
# A straight road seen along its direction is a point.
_LEAST_SIDE = 0.25
_REFERENCE_LINE = {"color": "#9a9a9a", "width": 5}
_ALIGNED = {
    "se3": "after SE(3) alignment",
    "first_pose": "after alignment of the first poses",
    "none": "without alignment",
}
_COMPONENTS = ("x, forward [m]", "y, left [m]", "z, up [m]", "roll [°]", "pitch [°]", "yaw [°]")
# Largest errors that differ by this factor cannot be read on one linear axis. A method whose errors exceed
# the others' by it leaves the picture, which ends at this multiple of the largest that stays.
_LOG_RATIO = 10.0
_BEYOND = 1.5
_MAP_CELLS = 60_000

Measured = Sequence[tuple[MethodResult, TrajectoryMetrics]]


def trajectory_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """All views; None when no method has a trajectory."""
    paths = {method.name: path for method in sequence.methods if (path := _aligned(method, sequence)) is not None}
    if not paths:
        return None
    reference = _matched_reference(sequence)
    low, high = _view(list(paths.values()), reference)
    extent, margin = np.maximum(high - low, 1.0), 0.05 * (high - low)
    ranges = np.stack([low - margin, high + margin], axis=1).tolist()
    views = [(0, 1)] + [(axis, 2) for axis in (0, 1) if extent[axis] >= _LEAST_SIDE * extent[:2].max()]
    panels = []
    for across, up in views:
        title = f"{'Top' if up == 1 else 'Side'} view: {'xyz'[up]} over {'xyz'[across]} [m]"
        traces = _traces(sequence, paths, reference, styles, (across, up))
        given = EQUAL_AXES if up == 1 else {"xaxis": {}, "yaxis": {}}
        layout = {
            **given,
            "xaxis": {**given["xaxis"], "title": {"text": f"{'xyz'[across]} [m]"}, "range": ranges[across]},
            "yaxis": {**given["yaxis"], "range": ranges[up]},
            "hovermode": "closest",
        }
        panels.append(Panel(title, traces, layout, _height_from_above(extent) if up == 1 else _SIDE_HEIGHT))
    name = "" if reference is None else sequence.reference_name
    return Figure("Trajectories", _trajectory_caption(sequence, paths, low, high), panels, list(paths), name)


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
    return np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int32)


def _view(paths: Sequence[FloatArray], reference: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of the first view: all paths but those that diverge."""
    kept = [path for path, inside in zip(paths, paths_in_bulk(paths, reference), strict=True) if inside]
    points = np.concatenate([*kept, *([] if reference is None else [reference])])
    low, high = points.min(axis=0), points.max(axis=0)
    short = np.maximum(_LEAST_HEIGHT_RANGE_M - (high - low), 0.0) / 2.0
    beyond = _BEYOND_VIEW * (high - low) if len(kept) < len(paths) else 0.0
    return low - short - beyond, high + short + beyond


def _trajectory_caption(
    sequence: SequenceComparison, paths: dict[str, FloatArray], low: FloatArray, high: FloatArray
) -> str:
    measured = sequence.measured
    unmeasured = [m.name for m in sequence.methods if m.trajectory is not None and m.metrics is None]
    if sequence.reference is None:
        frame = f"{'each ' if len(paths) > 1 else ''}in the frame of its first pose, as there is no reference"
    elif measured:
        frame = aligned_how(measured)
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


def error_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Position and orientation error over the distance travelled; None without a reference."""
    measured = sequence.measured
    errors = [metrics.absolute_errors() for _, metrics in measured]
    curves = {
        "Position error [m]": [metres for metres, _ in errors],
        "Orientation error [°]": [np.rad2deg(rad) for _, rad in errors],
    }
    caption = (
        f"Absolute trajectory error, {aligned_how(measured)}: distance between the estimated and the reference position"
        f" and angle between the orientations, over the distance travelled along the reference"
        f" ({sequence.reference_name}). Crosses mark scans on which tracking was lost."
    )
    return _over_distance("Absolute errors", caption, measured, curves, styles, signed=False)


def deviation_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Components of the error along and about the axes of the reference's LiDAR; None without a reference."""
    measured = sequence.measured
    found = [np.hstack(metrics.deviations()) for _, metrics in measured]
    curves = {title: [components[:, axis] for components in found] for axis, title in enumerate(_COMPONENTS)}
    caption = (
        "Pose of the estimate in the frame of the reference's LiDAR (x forward, y left, z up),"
        f" {aligned_how(measured)}, over the distance travelled along the reference."
    )
    return _over_distance("Error components", caption, measured, curves, styles, signed=True)


def _over_distance(
    title: str,
    caption: str,
    measured: Measured,
    curves: Mapping[str, Sequence[FloatArray]],
    styles: Styles,
    signed: bool,
) -> Figure | None:
    if not measured:
        return None
    panels = [_error_panel(title, measured, of, styles, signed) for title, of in curves.items()]
    names = [method.name for method, _ in measured]
    return Figure(title, caption + _leaving(measured, curves, signed), panels, names, columns=3 if signed else 2)


def aligned_how(measured: Measured) -> str:
    """How the estimates were aligned with the reference's world."""
    return " or ".join(dict.fromkeys(_ALIGNED[metrics.alignment] for _, metrics in measured))


def needs_log(curves: Sequence[FloatArray]) -> bool:
    """Whether the largest values of positive curves differ so much that a linear axis would hide the smaller ones."""
    largest = [float(np.nanmax(curve)) for curve in curves if np.isfinite(curve).any()]
    return bool(largest) and max(largest) > _LOG_RATIO * max(min(largest), 1e-9)


def _error_panel(title: str, measured: Measured, curves: Sequence[FloatArray], styles: Styles, signed: bool) -> Panel:
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


def drift_figures(sequence: SequenceComparison, styles: Styles) -> list[Figure | None]:
    """Drift by segment length, KITTI's and the short one, and KITTI's by the speed over the segment; None without."""
    short, kitti, by_speed = drift_series(sequence)
    caption = (
        "Mean translation error in percent of the segment length and mean rotation error per 100 m (segments of 100 to"
        " 800 m, as the KITTI development kit computes it) or per 10 m (segments of 5 to 100 m)."
    )
    speed_caption = "Mean errors over all segments of 100 to 800 m that were driven within 2 m/s of the speed."
    return [
        _drift_figure("Drift by segment length", caption, [kitti, short], "segment length [m]", short, styles),
        _drift_figure("Drift by speed", speed_caption, [by_speed], "speed over the segment [m/s]", by_speed, styles),
    ]


def _drift_figure(
    title: str, caption: str, parts: Sequence[DriftSeries], x_label: str, named: DriftSeries, styles: Styles
) -> Figure | None:
    """Translation and rotation of each part; the legend has the methods of `named`."""
    layout = {
        "xaxis": {"title": {"text": x_label}, "type": "category"},
        "yaxis": {"rangemode": "tozero"},
        "hovermode": "x unified",
    }
    panels = []
    for part in parts:
        if not part.places:
            continue
        titles = (f"Translation drift{part.over} [%]", f"Rotation drift{part.over} [° per {part.per_m} m]")
        for number, panel_title in enumerate(titles):
            curves = {name: np.array(part.of(name)[number], dtype=np.float64) for name in part.by_method}
            traces = [
                line_trace(
                    name, styles[name], [*map(str, part.places)], curve,
                    mode="lines+markers", marker=styles[name].marker, hovertemplate="%{y:.3f}",
                )
                for name, curve in curves.items()
            ]  # fmt: skip
            panels.append(Panel(panel_title, traces, layout, 250, needs_log(list(curves.values()))))
    return Figure(title, caption, panels, list(named.by_method)) if panels else None


def map_figure(sequence: SequenceComparison) -> Figure | None:
    """Each map's errors from above; None without a reference map."""
    maps = {m.name: m.map_errors for m in sequence.methods if m.map_errors is not None and len(m.map_errors.points)}
    if not maps:
        return None
    worst_m = _colour_range([errors.distances_m for errors in maps.values()])
    low, high = _box(list(maps.values()))
    return Figure(
        "Map errors",
        f"Maps from above. The colour of a cell is the median distance of its points from the reference map; the scale"
        f" ends at {worst_m:g} m.",
        [_map_panel(name, errors, low, high, worst_m) for name, errors in maps.items()],
    )


def raster(errors: CloudErrors, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Median distance (rows, columns) of the points in each cell; NaN where there is none."""
    from scipy.stats import binned_statistic_2d  # takes longer to load than the rest of a page

    x, y = errors.points[:, 0], errors.points[:, 1]
    finite = np.isfinite(errors.distances_m)
    bins = [y_edges, x_edges]
    median = binned_statistic_2d(y[finite], x[finite], errors.distances_m[finite], "median", bins).statistic
    return np.asarray(median, dtype=np.float64)


def _map_panel(name: str, errors: CloudErrors, low: FloatArray, high: FloatArray, worst_m: float) -> Panel:
    size = high - low
    cell_m = float(np.sqrt(size.prod() / _MAP_CELLS))
    x_edges, y_edges = (np.linspace(low[a], high[a], max(2, int(size[a] / cell_m) + 1)) for a in (0, 1))
    heat = go.Heatmap(
        z=np.float32(raster(errors, x_edges, y_edges)),
        x0=0.5 * (x_edges[0] + x_edges[1]), dx=x_edges[1] - x_edges[0],
        y0=0.5 * (y_edges[0] + y_edges[1]), dy=y_edges[1] - y_edges[0],
        coloraxis="coloraxis", hoverongaps=False, name="",
        hovertemplate="x %{x:.1f} m, y %{y:.1f} m<br>%{z:.3f} m from the reference",
    )  # fmt: skip
    layout = {
        **EQUAL_AXES,
        "xaxis": {**EQUAL_AXES["xaxis"], "title": {"text": "x [m]"}, "showgrid": False, "zeroline": False},
        "yaxis": {**EQUAL_AXES["yaxis"], "title": {"text": "y [m]"}, "showgrid": False, "zeroline": False},
        "hovermode": "closest",
        "coloraxis": {"cmin": 0.0, "cmax": worst_m, "colorbar": {"thickness": 10, "title": {"text": "[m]"}}},
    }
    return Panel(name, [heat], layout, _height_from_above(size))


def _height_from_above(size: FloatArray) -> int:
    return int(np.clip(_NOMINAL_WIDTH * size[1] / size[0], _LOWEST, _TALLEST))


def _colour_range(distances_m: list[FloatArray]) -> float:
    """End of the colour scale: the 95th percentile in the median map, with one digit."""
    ends = [np.percentile(of[np.isfinite(of)], 95.0) for of in distances_m if np.isfinite(of).any()]
    return max(float(f"{np.median(ends):.1g}"), 1e-3) if ends else 1.0


def _box(maps: list[CloudErrors]) -> tuple[FloatArray, FloatArray]:
    """Corners (2,) of the view, the same for all maps; a few stray points do not stretch it."""
    corners = [np.percentile(errors.points[:, :2], (0.2, 99.8), axis=0) for errors in maps]
    low, high = np.median(corners, axis=0)
    margin = 0.03 * (high - low) + 0.5
    return low - margin, high + margin
