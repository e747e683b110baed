"""Drift over the length of segments, and over the speed they were driven at."""

from collections.abc import Mapping, Sequence

import numpy as np

from evaluation.comparison.comparison import SequenceComparison
from evaluation.report.figures.curves import Curve, curve_panel
from evaluation.report.figures.errors import Measured, measured_methods
from evaluation.report.figures.figure import Figure, method_keys
from evaluation.report.figures.palette import Style
from evaluation.report.markup import Markup
from evaluation.trajectory.drift import KITTI_LENGTHS_M, SHORT_LENGTHS_M, Drift

_LENGTH = "segment length [m]"
Parts = list[tuple[str, Mapping[int, Drift | None]]]


def length_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """Drift by segment length, KITTI's and the short one; None when no recording is long enough for either."""
    measured = measured_methods(sequence)
    short: Parts = [(method.name, metrics.segments) for method, metrics in measured]
    panels = drift_panels(_kitti(measured, "length"), KITTI_LENGTHS_M, _LENGTH, 100, styles, ", 100 to 800 m")
    panels += drift_panels(short, SHORT_LENGTHS_M, _LENGTH, 10, styles, ", 5 to 100 m")
    if not panels:
        return None
    return Figure(
        title="Drift by segment length",
        caption=(
            "Mean translation error in percent of the segment's length, and mean rotation error for each 100 m"
            " (segments of 100 to 800 m, as the KITTI development kit computes it) or 10 m (segments of 5 to 100 m)."
        ),
        panels=panels,
        legend=method_keys([method.name for method, _ in measured], styles),
    )


def speed_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """KITTI's drift by the speed over the segment; None when no segment of 100 m exists."""
    measured = measured_methods(sequence)
    parts = _kitti(measured, "speed")
    speeds = sorted({mps for _, by_speed in parts for mps, drift in by_speed.items() if drift is not None})
    panels = drift_panels(parts, speeds, "speed over the segment [m/s]", 100, styles)
    if not panels:
        return None
    return Figure(
        title="Drift by speed",
        caption="Mean errors over all segments of 100 to 800 m that were driven within 2 m/s of the speed.",
        panels=panels,
        legend=method_keys([method.name for method, _ in measured], styles),
    )


def drift_panels(
    parts: Parts, places: Sequence[int], x_label: str, per_m: int, styles: Mapping[str, Style], over: str = ""
) -> list[Markup]:
    """A panel of translation and one of rotation over the places that any method has a figure at."""
    reached = [place for place in places if any(by_place.get(place) for _, by_place in parts)]
    if not reached:
        return []
    x = np.arange(len(reached), dtype=np.float64)
    translation, rotation = [], []
    for name, by_place in parts:
        drifts = [by_place.get(place) for place in reached]
        percent = np.array([drift.translation_percent if drift else np.nan for drift in drifts])
        degrees = np.array([drift.rotation_deg_per_m * per_m if drift else np.nan for drift in drifts])
        translation.append(Curve(name, styles[name], x, percent))
        rotation.append(Curve(name, styles[name], x, degrees))
    categories = [str(place) for place in reached]
    titles = (f"Translation drift{over} [%]", f"Rotation drift{over} [° per {per_m} m]")
    return [
        curve_panel(title, x_label, curves, height=190.0, categories=categories)
        for title, curves in zip(titles, (translation, rotation), strict=True)
    ]


def _kitti(measured: Measured, by: str) -> Parts:
    return [
        (method.name, metrics.kitti.by_length if by == "length" else metrics.kitti.by_speed)
        for method, metrics in measured
        if metrics.kitti is not None
    ]
