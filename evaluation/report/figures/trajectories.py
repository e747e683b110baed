"""Trajectories from above and from both sides, in the reference's world."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.comparison.comparison import SequenceComparison
from evaluation.report.figures.errors import aligned_how, measured_methods
from evaluation.report.figures.figure import Figure, lost_cross, lost_key, method_keys, reference_key
from evaluation.report.figures.palette import Style, marker
from evaluation.report.figures.panel import Panel, draw_panel, draw_width, polyline, scale_ticks, shortened, text
from evaluation.report.figures.scale import Scale, tick_texts, ticks, widened
from evaluation.report.figures.thinning import thin_path
from evaluation.report.markup import Markup, element, escape
from evaluation.trajectory.aligned_positions import aligned_positions
from evaluation.trajectory.lost_stretches import lost_stretches
from lidarslam.core.geometry import FloatArray

_WIDTH, _TALLEST, _FLATTEST = 540.0, 470.0, 130.0
# A trajectory may leave the reference's box by this share of the box's size before it leaves the picture.
_BEYOND = 0.35
# A street without a bend looks like a line from its end.
_WORTH_A_VIEW = 0.25
_EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True, eq=False)
class _Path:
    """A method's aligned positions (N, 3), and the rows of its lost stretches."""

    name: str
    style: Style
    positions: FloatArray
    lost: Sequence[tuple[int, int]]


def trajectory_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """All views; None when no method has a trajectory."""
    paths = [
        _Path(method.name, styles[method.name], positions, [(s.first, s.last) for s in lost_stretches(method)])
        for method in sequence.methods
        if (positions := aligned_positions(method, sequence)) is not None
    ]
    if not paths:
        return None
    reference = None if sequence.reference is None else sequence.reference.positions
    low, high = _box(paths, reference)
    above = _view("From above: y [m] over x [m]", paths, reference, (0, 1), (low, high), 1)
    exaggeration = _exaggeration(float((high - low)[:2].max()), float(high[2] - low[2]))
    heights = f", heights ×{exaggeration}" if exaggeration > 1 else ""
    sides = [
        _view(f"From the side: z [m] over {name} [m]{heights}", paths, reference, (axis, 2), (low, high), exaggeration)
        for axis, name in enumerate("xy")
        if high[axis] - low[axis] >= _WORTH_A_VIEW * (high - low)[:2].max()
    ]
    legend = method_keys([path.name for path in paths], styles)
    legend += [reference_key(sequence.reference_name)] if reference is not None else []
    legend += [lost_key()] if any(path.lost for path in paths) else []
    return Figure(
        "Trajectories", _caption(sequence, exaggeration), [above, element("div", *sides, class_="stack")], legend
    )


def _caption(sequence: SequenceComparison, exaggeration: int) -> str:
    measured = measured_methods(sequence)
    unmeasured = [m.name for m in sequence.methods if m.trajectory is not None and m.metrics is None]
    if sequence.reference is None:
        worlds = "each in the frame of its first pose, as there is no reference"
    elif measured:
        worlds = f"{aligned_how(measured)} ({sequence.reference_name})"
        worlds += f"; by the first pose only: {', '.join(unmeasured)}" if unmeasured else ""
    else:
        worlds = f"brought to the reference ({sequence.reference_name}) by the first pose"
    scale = f" Heights in the side views are drawn {exaggeration} times larger." if exaggeration > 1 else ""
    return (
        f"Paths of all methods, {worlds}. A circle marks the start, each method's marker its end."
        f" From above both axes have one scale.{scale}"
    )


def _box(paths: Sequence[_Path], reference: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of what is shown: the reference and what does not stray far from it."""
    ours = np.concatenate([path.positions for path in paths])
    if reference is None or not len(reference):
        return ours.min(axis=0), ours.max(axis=0)
    low, high = reference.min(axis=0), reference.max(axis=0)
    room = _BEYOND * max(float((high - low).max()), 1.0)
    return np.minimum(low, np.maximum(ours.min(axis=0), low - room)), np.maximum(
        high, np.minimum(ours.max(axis=0), high + room)
    )


def _exaggeration(across_m: float, up_m: float) -> int:
    """How many times larger heights may be drawn for the view to be at most two fifths as high as wide."""
    fitting = [factor for factor in _EXAGGERATIONS if factor * max(up_m, 0.5) <= 0.42 * max(across_m, 1.0)]
    return fitting[-1] if fitting else 1


def _view(
    title: str,
    paths: Sequence[_Path],
    reference: FloatArray | None,
    axes: tuple[int, int],
    box: tuple[FloatArray, FloatArray],
    exaggeration: int,
) -> Markup:
    x, y = _scales(box, axes, exaggeration)
    width, height = x.end, y.start
    x_values = ticks(x.low, x.high, max(3, round(width / 85)))
    y_values = ticks(y.low, y.high, max(3, round(height / 52)))
    panel = Panel(
        title,
        f"Paths of {', '.join(path.name for path in paths)}.",
        width,
        height,
        f"{'xyz'[axes[0]]} [m]",
        scale_ticks(x, x_values.tolist(), tick_texts(x_values)),
        scale_ticks(y, y_values.tolist(), tick_texts(y_values)),
        grid="xy",
    )
    content = []
    if reference is not None:
        d = _path_data(reference, axes, x, y)
        content.append(
            element(
                "path",
                d=d,
                fill="none",
                stroke="#b4b4b4",
                stroke_width=4.5,
                class_="reference",
                stroke_linejoin="round",
            )
        )
    content += [_draw(path, axes, x, y) for path in paths]
    content += [_start(paths[0].positions if reference is None else reference, axes, x, y)]
    return draw_panel(panel, content, _beyond_note(paths, axes, x, y, width))


def _scales(box: tuple[FloatArray, FloatArray], axes: tuple[int, int], exaggeration: int) -> tuple[Scale, Scale]:
    """Scales with the same pixels a metre, but for the exaggeration, with what is shown in the middle."""
    low, high = box
    (x_low, x_high), (y_low, y_high) = (widened(float(low[a]), float(high[a]), 0.05, 0.25) for a in axes)
    width = draw_width(_WIDTH)
    height = float(np.clip(width * exaggeration * (y_high - y_low) / (x_high - x_low), _FLATTEST, _TALLEST))
    px_per_m = min(width / (x_high - x_low), height / (exaggeration * (y_high - y_low)))
    half_x, half_y = 0.5 * width / px_per_m, 0.5 * height / (px_per_m * exaggeration)
    x_mid, y_mid = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high)
    return Scale(x_mid - half_x, x_mid + half_x, 0.0, width), Scale(y_mid - half_y, y_mid + half_y, height, 0.0)


def _draw(path: _Path, axes: tuple[int, int], x: Scale, y: Scale) -> Markup:
    line = element(
        "path",
        d=_path_data(path.positions, axes, x, y),
        fill="none",
        stroke=path.style.colour,
        stroke_width=1.7,
        stroke_dasharray=path.style.dash or None,
        stroke_linejoin="round",
        class_=path.style.stroke_class,
    )
    lost, crosses = [], []
    for first, last in path.lost:
        stretch = path.positions[max(first - 1, 0) : last + 1]
        lost.append(_path_data(stretch, axes, x, y))
        crosses.append(lost_cross(x.at(float(stretch[0, axes[0]])), y.at(float(stretch[0, axes[1]]))))
    halo = element(
        "path", d="".join(lost), fill="none", stroke=path.style.colour, stroke_width=7.0, stroke_opacity=0.35,
        class_=f"lost-halo {path.style.stroke_class}",
    )  # fmt: skip
    end = path.positions[-1]
    end_marker = marker(path.style, x.at(float(end[axes[0]])), y.at(float(end[axes[1]])))
    halos = [halo] if lost else []
    return element("g", element("title", escape(path.name)), *halos, line, *crosses, end_marker, class_="curve")


def _path_data(positions: FloatArray, axes: tuple[int, int], x: Scale, y: Scale) -> str:
    # Far outside the picture the path is bent towards it: browsers lose digits on coordinates of millions.
    pixels = np.stack(
        [np.clip(x(positions[:, axes[0]]), -2e4, 2e4), np.clip(y(positions[:, axes[1]]), -2e4, 2e4)], axis=-1
    )
    thinned = thin_path(pixels)
    return polyline(thinned[:, 0], thinned[:, 1])


def _start(positions: FloatArray, axes: tuple[int, int], x: Scale, y: Scale) -> Markup:
    cx, cy = x.at(float(positions[0, axes[0]])), y.at(float(positions[0, axes[1]]))
    return element("circle", cx=cx, cy=cy, r=5.5, class_="start", fill="none", stroke="#1a1a1a", stroke_width=1.5)


def _beyond_note(paths: Sequence[_Path], axes: tuple[int, int], x: Scale, y: Scale, width: float) -> list[Markup]:
    """Names the methods whose paths leave the picture."""
    gone = [
        path.name
        for path in paths
        for a, b in [(path.positions[:, axes[0]], path.positions[:, axes[1]])]
        if a.min() < x.low or a.max() > x.high or b.min() < y.low or b.max() > y.high
    ]
    if not gone:
        return []
    names = ", ".join(shortened(name, 18) for name in gone[:3])
    more = f" and {len(gone) - 3} more" if len(gone) > 3 else ""
    return [text(f"beyond the picture: {names}{more}", width, -5.0, size=10.0, anchor="end", quiet=True)]
