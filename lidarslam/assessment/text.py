"""Text that `lidarslam evaluate` prints."""

from collections.abc import Iterator, Mapping

from lidarslam.assessment.evaluate import Evaluation, MapEvaluation
from lidarslam.core.text import as_typed, command_line, joined
from lidarslam.evaluation.map.entropy import MapEntropy
from lidarslam.evaluation.trajectory.drift import Drift
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics

_LABEL = 18
_ALIGNED = {"se3": "after SE(3) alignment", "first_pose": "first poses aligned", "none": "not aligned"}
_MAP_ALIGNED = {
    "trajectory": "along the trajectory",
    "none": "taken as given",
    "global": "by global registration",
    "file": "by the pose given",
}


def format_evaluation(evaluation: Evaluation) -> str:
    """The figures as aligned lines of text: trajectory, drift, map, notes."""
    return joined(_lines(evaluation))


def _lines(evaluation: Evaluation) -> Iterator[str]:
    yield _row("evaluated", evaluation.estimate.poses.label)
    if evaluation.metrics is not None:
        yield _row("against", str(evaluation.reference))
        yield from _trajectory(evaluation.metrics)
    if evaluation.map is not None:
        yield from _map(evaluation.map)
    if evaluation.entropy is not None:
        yield from _entropy(evaluation.entropy, with_title=evaluation.map is None)
    yield from [""] if evaluation.notes else []
    yield from (f"note: {note}" for note in evaluation.notes)
    if evaluation.written:
        yield from ("", f"written to {', '.join(map(str, evaluation.written))}")
    if evaluation.estimate.run is not None:
        yield f"next: {command_line(as_typed('lidarslam'), 'view', str(evaluation.estimate.run))}"


def _row(label: str, text: str) -> str:
    return f"{label:<{_LABEL}}{text}"


def _trajectory(metrics: TrajectoryMetrics) -> Iterator[str]:
    association, errors = metrics.association, metrics.errors
    counts = f"{len(association):,} of {association.estimate_count:,}"
    yield _row("poses matched", f"{counts} ({association.reference_count:,} in the reference), {errors.length_m:.1f} m")
    yield from ("", _row("TRAJECTORY", f"{'translation':>12}{'rotation':>14}"))
    rows = (
        ("ATE, RMSE", errors.ate_rmse_m, errors.ate_rotation_rmse_deg, _ALIGNED[metrics.alignment]),
        ("RPE, RMSE", errors.rpe_translation_rmse_m, errors.rpe_rotation_rmse_deg, "from one scan to the next"),
        ("end error", errors.end_error_m, None, "first poses aligned"),
    )
    for label, metres, degrees, how in rows:
        yield _row(label, f"{_number(metres, 'm'):>12}{_number(degrees, 'deg'):>14}    {how}")
    if metrics.kitti is not None:
        lengths = {f"{m} m": drift for m, drift in metrics.kitti.by_length.items()}
        speeds = {f"{3.6 * v:.0f} km/h": drift for v, drift in metrics.kitti.by_speed.items()}
        yield from _drifts("KITTI DRIFT", {"all": metrics.kitti.overall, **lengths}, 100)
        yield from _drifts("BY SPEED", speeds, 100)
    yield from _drifts("SHORT SEGMENTS", {f"{m} m": drift for m, drift in metrics.segments.items()}, 10)
    yield from ("",) if metrics.plugins else ()
    yield from (_row(f"{name} ", text) for name, text in metrics.plugin_lines())


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3f} {unit}"


def _drifts(title: str, drifts: Mapping[str, Drift | None], per_m: int) -> Iterator[str]:
    present = {label: drift for label, drift in drifts.items() if drift is not None}
    if present:
        yield from ("", _row(title, f"{'translation':>12}{'rotation':>22}{'segments':>12}"))
    for label, drift in present.items():
        rotation = f"{drift.rotation_deg_per_m * per_m:.3f} deg per {per_m} m"
        yield f"{label:>{_LABEL - 2}}  {drift.translation_percent:>10.3f} %{rotation:>22}{drift.segments:>12,}"


def _map(compared: MapEvaluation) -> Iterator[str]:
    metrics, alignment = compared.comparison.metrics, compared.alignment
    refinement = "not refined"
    if alignment.refined:
        moved = f", which moved it by {alignment.moved_m:.3f} m and {alignment.moved_deg:.2f} deg"
        refinement = f"then by ICP{'' if alignment.method == 'global' else moved}"
    yield from ("", _row("MAP against", compared.reference))
    yield _row("aligned", f"{_MAP_ALIGNED.get(alignment.method, alignment.method)}, {refinement}")
    rmse = "" if alignment.inlier_rmse_m is None else f", RMSE {alignment.inlier_rmse_m:.3f} m"
    yield _row("inliers", f"{100.0 * alignment.fitness:.1f} % of the map within {alignment.inlier_m:.2g} m{rmse}")
    reach = f"mean, reference to map, within {compared.max_range_m:g} m of the path"
    for label, metres, meaning in (
        ("accuracy", metrics.accuracy_mean_m, "mean, map to reference"),
        ("completeness", metrics.completeness_mean_m, reach),
        ("chamfer", metrics.chamfer_m, "mean of the two"),
    ):
        yield _row(label, f"{_number(metres, 'm'):>12}    {meaning}")
    yield _row("F-score", _percentages(metrics.f_score_percent))
    yield _row("coverage", f"{_percentages(metrics.coverage_percent)}, of the reference")
    yield _row("deviation", f"{_percentages(metrics.deviation_percent)}, of the map, beyond")


def _percentages(shares: Mapping[float, float | None]) -> str:
    texts = (f"{'-' if share is None else f'{share:.1f}'} % at {m:g} m" for m, share in shares.items())
    return "  " + ", ".join(f"{text:>10}" for text in texts)


def _entropy(entropy: MapEntropy, with_title: bool) -> Iterator[str]:
    yield from ("", "MAP") if with_title else ()
    yield _row("mean map entropy", f"{entropy.mean:>10.3f}      within {entropy.radius_m:g} m; lower is crisper")
