"""Errors over the distance travelled: in all, and along each axis."""

from collections.abc import Mapping

import numpy as np

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.report.figures.curves import Curve, curve_panel
from evaluation.report.figures.figure import Figure, lost_key, method_keys
from evaluation.report.figures.palette import Style
from evaluation.report.markup import Markup
from evaluation.trajectory.deviation import deviation
from evaluation.trajectory.lost_stretches import lost_stretches
from evaluation.trajectory.metrics import TrajectoryMetrics, absolute_errors
from lidarslam.core.geometry import FloatArray

_DISTANCE = "distance travelled [m]"
_AXES = (
    ("x, forward [m]", "translation", 0),
    ("y, left [m]", "translation", 1),
    ("z, up [m]", "translation", 2),
    ("roll [°]", "rotation", 0),
    ("pitch [°]", "rotation", 1),
    ("yaw [°]", "rotation", 2),
)
_ALIGNED = {
    "se3": "after SE(3) alignment",
    "first_pose": "with the first poses made to coincide",
    "none": "without alignment",
}

Measured = list[tuple[MethodResult, TrajectoryMetrics]]


def error_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """Position and orientation errors over the distance travelled; None when nothing was compared."""
    measured = measured_methods(sequence)
    if not measured:
        return None
    distance_curves, angle_curves = [], []
    for method, metrics in measured:
        errors_m, errors_rad = absolute_errors(metrics.association, metrics.T_reference_estimate)
        travelled = metrics.association.reference.distances
        lost_m = lost_distances(method, metrics)
        distance_curves.append(Curve(method.name, styles[method.name], travelled, errors_m, lost_m))
        angle_curves.append(Curve(method.name, styles[method.name], travelled, np.rad2deg(errors_rad), lost_m))
    return Figure(
        title="Errors along the way",
        caption=(
            f"Distance between the estimated and the reference position, and angle between the orientations,"
            f" {aligned_how(measured)}, over the distance travelled along the reference ({sequence.reference_name})."
        ),
        panels=[
            curve_panel("Position error [m]", _DISTANCE, distance_curves),
            curve_panel("Orientation error [°]", _DISTANCE, angle_curves),
        ],
        legend=_legend(measured, styles),
    )


def deviation_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """Deviation along each axis over the distance travelled; None when nothing was compared."""
    measured = measured_methods(sequence)
    if not measured:
        return None
    found = [
        (method, metrics, deviation(metrics.association, metrics.T_reference_estimate)) for method, metrics in measured
    ]
    panels = []
    for title, part, axis in _AXES:
        curves = [
            Curve(
                method.name,
                styles[method.name],
                off.distances_m,
                (off.translation_m if part == "translation" else off.rotation_deg)[:, axis],
                lost_distances(method, metrics),
            )
            for method, metrics, off in found
        ]
        panels.append(curve_panel(title, _DISTANCE, curves, width=370.0, height=150.0))
    return Figure(
        title="Deviation along each axis",
        caption=(
            "Position and orientation of the estimate in the frame of the reference's LiDAR (x forward, y left, z up),"
            f" {aligned_how(measured)}, over the distance travelled along the reference."
        ),
        panels=panels,
        legend=_legend(measured, styles),
        columns=3,
    )


def measured_methods(sequence: SequenceComparison) -> Measured:
    """The methods that were held against the reference."""
    return [(method, method.metrics) for method in sequence.methods if method.metrics is not None]


def aligned_how(measured: Measured) -> str:
    """How the estimates were brought to the reference's world."""
    return " or ".join(dict.fromkeys(_ALIGNED[metrics.alignment] for _, metrics in measured))


def lost_distances(method: MethodResult, metrics: TrajectoryMetrics) -> FloatArray:
    """Distance travelled along the reference at which each lost stretch begins, where the reference reaches it."""
    if method.trajectory is None:
        return np.zeros(0)
    stamps = metrics.association.reference.stamps
    begins = np.array([stretch.begin_s for stretch in lost_stretches(method)], dtype=np.float64)
    inside = begins[(begins >= stamps[0]) & (begins <= stamps[-1])]
    return np.asarray(np.interp(inside, stamps, metrics.association.reference.distances), dtype=np.float64)


def _legend(measured: Measured, styles: Mapping[str, Style]) -> list[Markup]:
    keys = method_keys([method.name for method, _ in measured], styles)
    return [*keys, lost_key()] if any(method.lost_scans for method, _ in measured) else keys
