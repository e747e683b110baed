"""What `lidarslam evaluate` prints."""

from collections.abc import Iterable, Iterator, Mapping

from evaluation.map.entropy import MapEntropy
from evaluation.map.metrics import MapMetrics
from evaluation.trajectory.drift import Drift, KittiDrift
from evaluation.trajectory.metrics import TrajectoryErrors, TrajectoryMetrics
from lidarslam.evaluate.evaluate import Evaluation
from lidarslam.evaluate.map_evaluation import MapEvaluation

_LABEL = 18
_ALIGNED = {"se3": "after SE(3) alignment", "first_pose": "first poses aligned", "none": "as they are, not aligned"}
_MAP_ALIGNED = {
    "trajectory": "along the trajectory",
    "none": "taken as given",
    "global": "found by a global search",
    "file": "by the pose given",
}


def format_evaluation(evaluation: Evaluation) -> str:
    """The figures as aligned lines of text, by trajectory, drift and map."""
    return "\n".join(_lines(evaluation))


def _lines(evaluation: Evaluation) -> Iterator[str]:
    yield _row("evaluated", evaluation.estimate.poses.what)
    if evaluation.metrics is not None:
        yield _row("against", str(evaluation.reference))
        yield from _trajectory(evaluation.metrics)
    if evaluation.map is not None:
        yield ""
        yield from _map(evaluation.map)
    if evaluation.entropy is not None:
        yield from _entropy(evaluation.entropy, with_title=evaluation.map is None)
    if evaluation.notes:
        yield ""
    for note in evaluation.notes:
        yield f"note: {note}"
    if evaluation.written:
        yield ""
        yield f"written to {', '.join(map(str, evaluation.written))}"


def _row(label: str, text: str) -> str:
    return f"{label:<{_LABEL}}{text}"


def _trajectory(metrics: TrajectoryMetrics) -> Iterator[str]:
    association, errors = metrics.association, metrics.errors
    matched = (
        f"{len(association):,} of {association.estimate_count:,} ({association.reference_count:,} in the reference)"
    )
    yield _row("poses matched", f"{matched}, {errors.length_m:.1f} m")
    yield ""
    yield _row("TRAJECTORY", f"{'translation':>12}{'rotation':>14}")
    yield from _errors(errors, _ALIGNED[metrics.alignment])
    if metrics.kitti is not None:
        yield from _kitti(metrics.kitti)
    segments = [(f"{m} m", drift) for m, drift in metrics.segments.items() if drift is not None]
    if segments:
        yield ""
        yield _row("SHORT SEGMENTS", f"{'translation':>12}{'rotation':>14}{'segments':>20}")
        yield from (
            f"{label:>{_LABEL - 2}}  {drift.translation_percent:>10.3f} %"
            f"{10.0 * drift.rotation_deg_per_m:>10.3f} deg per 10 m{drift.segments:>10,}"
            for label, drift in segments
        )


def _errors(errors: TrajectoryErrors, aligned: str) -> Iterator[str]:
    yield _row("ATE, RMSE", f"{_metres(errors.ate_rmse_m)}{_degrees(errors.ate_rotation_rmse_deg)}    {aligned}")
    step = _degrees(errors.rpe_rotation_rmse_deg)
    yield _row("RPE, RMSE", f"{_metres(errors.rpe_translation_rmse_m)}{step}    from one scan to the next")
    yield _row("at the end", f"{_metres(errors.end_error_m)}{'':>14}    when the first poses coincide")


def _metres(value: float | None) -> str:
    return f"{'-':>12}" if value is None else f"{value:>10.3f} m"


def _degrees(value: float | None) -> str:
    return f"{'-':>14}" if value is None else f"{value:>10.3f} deg"


def _kitti(kitti: KittiDrift) -> Iterator[str]:
    yield ""
    yield _row("KITTI DRIFT", f"{'translation':>12}{'rotation':>14}{'segments':>21}")
    yield _drift("all", kitti.overall)
    yield from _drifts((f"{m} m", drift) for m, drift in kitti.by_length.items())
    yield ""
    yield _row("BY SPEED", f"{'translation':>12}{'rotation':>14}{'segments':>21}")
    yield from _drifts((f"{3.6 * v:.0f} km/h", drift) for v, drift in kitti.by_speed.items())


def _drifts(drifts: Iterable[tuple[str, Drift | None]]) -> Iterator[str]:
    return (_drift(label, drift) for label, drift in drifts if drift is not None)


def _drift(label: str, drift: Drift) -> str:
    rotation = f"{drift.rotation_deg_per_m:>12.5f} deg/m"
    return f"{label:>{_LABEL - 2}}  {drift.translation_percent:>10.3f} %{rotation}{drift.segments:>17,}"


def _map(compared: MapEvaluation) -> Iterator[str]:
    metrics, alignment = compared.comparison.metrics, compared.alignment
    yield _row("MAP against", compared.reference)
    how = _MAP_ALIGNED.get(alignment.method, alignment.method)
    yield _row("aligned", f"{how}, {_refinement(compared)}")
    rmse = "" if alignment.inlier_rmse_m is None else f", RMSE {alignment.inlier_rmse_m:.3f} m"
    yield _row("overlap", f"{100.0 * alignment.fitness:.1f} % of the map within {alignment.inlier_m:.2g} m{rmse}")
    yield _row("accuracy", f"{_metres(metrics.accuracy_mean_m)}    mean, map to reference")
    reach = f"seen from within {compared.max_range_m:g} m"
    yield _row("completeness", f"{_metres(metrics.completeness_mean_m)}    mean, reference to map, {reach}")
    yield _row("chamfer", f"{_metres(metrics.chamfer_m)}    mean of the two")
    yield from _shares(metrics)


def _refinement(compared: MapEvaluation) -> str:
    alignment = compared.alignment
    if not alignment.refined:
        return "not refined"
    if alignment.method == "global":
        return "then by ICP"
    return f"then by ICP, which moved it by {alignment.moved_m:.3f} m and {alignment.moved_deg:.2f} deg"


def _shares(metrics: MapMetrics) -> Iterator[str]:
    yield _row("F-score", _percentages(metrics.f_score_percent))
    yield _row("coverage", f"{_percentages(metrics.coverage_percent)}, of the reference")
    yield _row("deviation", f"{_percentages(metrics.deviation_percent)}, of the map, farther off")


def _percentages(shares: Mapping[float, float | None]) -> str:
    texts = (f"{'-' if share is None else f'{share:.1f}'} % at {m:g} m" for m, share in shares.items())
    return "  " + ", ".join(f"{text:>10}" for text in texts)


def _entropy(entropy: MapEntropy, with_title: bool) -> Iterator[str]:
    if with_title:
        yield ""
        yield "MAP"
    yield _row("mean map entropy", f"{entropy.mean:>10.3f}      within {entropy.radius_m:g} m; lower is crisper")
