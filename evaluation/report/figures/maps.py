"""Quality of maps: errors from above where there is a reference map, mean map entropy where there is none."""

import numpy as np
import plotly.graph_objects as go

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.comparison.comparison import MapErrors, SequenceComparison
from lidarslam.evaluation.report.figures.figure import EQUAL_AXES, Figure, Panel, Styles, line_trace, plot_text

_NOMINAL_WIDTH, _LOWEST, _TALLEST = 480.0, 220.0, 480.0
_MOST_CELLS = 60_000


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
        [_panel(name, errors, low, high, worst_m) for name, errors in maps.items()],
    )


def entropy_figure(sequence: SequenceComparison, styles: Styles) -> Figure | None:
    """Mean map entropy, which needs no reference; None where there is a reference map, or no map."""
    entropies = {m.name: m.map_entropy for m in sequence.methods if m.map_entropy is not None}
    if not entropies or any(method.map_metrics is not None for method in sequence.methods):
        return None
    points = [
        line_trace(
            name, styles[name], np.array([entropy]), [plot_text(name)],
            mode="markers", marker={**styles[name].marker, "size": 12}, hovertemplate="%{x:.3f}",
        )
        for name, entropy in entropies.items()
    ]  # fmt: skip
    layout = {"xaxis": {"zeroline": False}, "yaxis": {"autorange": "reversed"}, "hovermode": "closest"}
    panel = Panel("Mean map entropy", points, layout, 70 + 30 * len(points))
    caption = (
        "Mean entropy of the points within 0.3 m of each map point (Droeschel et al., ICRA 2014); lower is crisper."
        " It needs no reference; a method that lost tracking may have a crisp map of a part."
    )
    return Figure("Map quality without a reference", caption, [panel], list(entropies))


def raster(errors: MapErrors, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Median distance (rows, columns) of the points in each cell; NaN where there is none."""
    from scipy.stats import binned_statistic_2d  # takes longer to load than the rest of a page

    x, y = errors.points[:, 0], errors.points[:, 1]
    finite = np.isfinite(errors.distances_m)
    bins = [y_edges, x_edges]
    median = binned_statistic_2d(y[finite], x[finite], errors.distances_m[finite], "median", bins).statistic
    return np.asarray(median, dtype=np.float64)


def _panel(name: str, errors: MapErrors, low: FloatArray, high: FloatArray, worst_m: float) -> Panel:
    size = high - low
    cell_m = float(np.sqrt(size.prod() / _MOST_CELLS))
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
    return Panel(name, [heat], layout, int(np.clip(_NOMINAL_WIDTH * size[1] / size[0], _LOWEST, _TALLEST)))


def _colour_range(distances_m: list[FloatArray]) -> float:
    """End of the colour scale: the 95th percentile in the median map, with one digit."""
    ends = [np.percentile(of[np.isfinite(of)], 95.0) for of in distances_m if np.isfinite(of).any()]
    return max(float(f"{np.median(ends):.1g}"), 1e-3) if ends else 1.0


def _box(maps: list[MapErrors]) -> tuple[FloatArray, FloatArray]:
    """Corners (2,) of the view, the same for all maps; a few stray points do not stretch it."""
    corners = [np.percentile(errors.points[:, :2], (0.2, 99.8), axis=0) for errors in maps]
    low, high = np.median(corners, axis=0)
    margin = 0.03 * (high - low) + 0.5
    return low - margin, high + margin
