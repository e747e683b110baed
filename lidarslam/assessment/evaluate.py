"""Evaluation of a run directory or a trajectory file: metrics.json, files of the errors, and text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarslam.assessment.inputs import (
    Estimate,
    Poses,
    ReferenceMap,
    find_reference_map,
    load_reference_map,
    pair,
    read_estimate,
    read_reference,
)
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import written
from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.point_files import Columns, write_ply
from lidarslam.core.text import as_typed, command_line, joined
from lidarslam.core.trajectory import Trajectory, read_transform
from lidarslam.evaluation.comparison.comparison import GROUND_TRUTH, MethodResult
from lidarslam.evaluation.map.alignment import GLOBAL, MapAlignment, align_map
from lidarslam.evaluation.map.entropy import RADIUS_M, MapEntropy, map_entropy
from lidarslam.evaluation.map.metrics import (
    DEFAULT_SPACING_M,
    F_SCORE_THRESHOLDS_M,
    CloudErrors,
    MapComparison,
    compare_maps,
)
from lidarslam.evaluation.report.drawing import DEFAULT_CLIP_M, DISTANCE_FIELD, error_colours
from lidarslam.evaluation.trajectory.alignment import (
    DEFAULT_MAX_GAP_S,
    DEFAULT_TOLERANCE_S,
    AlignmentMethod,
    align,
    align_poses,
    common_instants,
)
from lidarslam.evaluation.trajectory.metrics import (
    Drift,
    TrajectoryMetrics,
    disagreement,
    evaluate_trajectory,
    metrics_json,
)
from lidarslam.mapping.global_map.point_cloud import COLOURS
from lidarslam.storage import directory as files
from lidarslam.storage.directory import RunDirectory

_SUFFIXES = (".ply", ".rrd")
_DRAWN_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class MapEvaluation:
    """Errors of a map."""

    reference: str  # description of the reference map
    alignment: MapAlignment  # of the map with it
    comparison: MapComparison  # the errors, in numbers and point by point
    entropy: MapEntropy | None  # of the map by itself; None when it is too sparse
    positions: FloatArray  # (K, 3) of the sensor, in the reference's frame
    max_range_m: float  # range of the sensor

    @property
    def json(self) -> dict[str, object]:
        """The content of metrics.json's "map"."""
        entropy = None if self.entropy is None else self.entropy.mean
        return {**self.comparison.metrics.to_json(), "mean_map_entropy": entropy}

    @property
    def errors(self) -> CloudErrors:
        """The map's errors point by point, thinned for drawing."""
        return self.comparison.map_errors.thinned(_DRAWN_POINTS)

    def warnings(self) -> Iterator[str]:
        """Reasons not to trust the figures."""
        alignment, gap_m = self.alignment, self.comparison.map_gap_m
        if not alignment.is_trustworthy:
            yield (
                f"only {100.0 * alignment.least_fitness:.0f} % of the surfaces of one direction lie within"
                f" {alignment.inlier_m:g} m of the reference: the map is bent or misaligned; look at it with"
                " --errors FILE.ply"
            )
        if gap_m is not None and gap_m > F_SCORE_THRESHOLDS_M[0]:
            yield (
                f"the map's points are {gap_m:.2f} m apart, which limits completeness and the F-score at"
                f" {F_SCORE_THRESHOLDS_M[0]:g} m; run again with --set global_map.voxel_size_m=0.05"
            )


@dataclass(frozen=True)
class EvaluateRequest:
    """Estimate, references and outputs."""

    run: Path | Trajectory  # a run directory, or a trajectory, in memory or in TUM or KITTI text
    # a trajectory likewise, a run directory or a recording; None: the truth that came with the run's source
    reference: Path | Trajectory | None = None
    reference_map: Path | None = None  # a cloud; None: the exact map of a simulated source, else none
    map_file: Path | None = None  # the map of a bare trajectory, or another one than the run's
    alignment: AlignmentMethod = "se3"  # of the trajectory, for the ATE
    # tolerance_s, max_gap_s: of the association in time
    tolerance_s: float = DEFAULT_TOLERANCE_S
    max_gap_s: float = DEFAULT_MAX_GAP_S
    # initial `T_reference_map`. "trajectory": the alignment of the trajectory with one in the reference map's world;
    # "none": the identity; "global": global registration; or the name of a text file with the 4x4 matrix. "auto": the
    # trajectory where it is known to be in the reference map's world, else the first of trajectory, none and global
    # that fits.
    map_alignment: str = "auto"
    refine: bool | None = None  # whether ICP follows; None: unless the map's alignment is "none"
    spacing_m: float = DEFAULT_SPACING_M  # edge of the cells that both clouds are thinned to one point in
    max_range_m: float | None = None  # range of the sensor; None: that of the run's map
    errors: Sequence[Path] = ()  # files for the map coloured by its errors
    errors_clip_m: float = DEFAULT_CLIP_M  # distance of the brightest colour
    out: Path | None = None  # file for the figures; None: metrics.json of the run, and nothing of a bare trajectory
    needs_reference: bool = True  # whether it is an error that there is no reference
    write: bool = True  # whether the figures are written
    report: bool = False  # whether the page of the run is drawn again, with the errors; not if the figures go elsewhere

    def __post_init__(self) -> None:
        if self.map_alignment == GLOBAL and self.refine is False:
            raise ConfigError("a global search is good to a metre only; let --refine follow it")


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors of an estimate."""

    estimate: Estimate  # the trajectory and its map
    reference: str | None  # description of the reference trajectory; None without one
    metrics: TrajectoryMetrics | None  # errors of the trajectory
    map: MapEvaluation | None  # errors of the map; None without a map or a reference for it
    entropy: MapEntropy | None  # of the map; None without a map
    notes: Sequence[str]  # remarks for the reader
    written: Sequence[Path]  # the files

    def to_json(self) -> dict[str, object]:
        """The content of metrics.json."""
        return {
            **metrics_json(self.metrics, None if self.map is None else self.map.json),
            "map_alignment": self.map and self.map.alignment.to_json(),
            "map_entropy": self.entropy and self.entropy.to_json(),
            "notes": list(self.notes),
        }


def evaluate(request: EvaluateRequest) -> Evaluation:
    """Compare, and write the figures; InputError where there is no reference."""
    check_error_files(request.errors)
    estimate = read_estimate(request.run, request.map_file)
    notes: list[str] = []
    reference, metrics, trajectory = _reference(request, estimate, notes), None, None
    if reference is not None:
        trajectory, true = pair(estimate, reference)
        metrics = evaluate_trajectory(trajectory, true, request.tolerance_s, request.max_gap_s, request.alignment)
        notes += [warning] if (warning := disagreement(metrics)) is not None else []
    # Poses of KITTI's camera do not give the LiDAR's world.
    in_camera = estimate.run is not None and reference is not None and not reference.has_stamps
    compared = _evaluate_map(request, estimate, None if in_camera else metrics, notes)
    if request.errors and compared is None:
        raise InputError("--errors colours a map by its distance to a reference; name one with --reference-map MAP")
    entropy = None
    if compared is not None:
        entropy = compared.entropy
        notes += compared.warnings()
    elif estimate.map_file is not None:
        entropy = map_entropy(estimate.map_points())
    out = request.out or (None if estimate.run is None or not request.write else estimate.run / files.METRICS)
    saved = [*([] if out is None else [out]), *request.errors]
    label = None if reference is None else reference.label
    evaluation = Evaluation(estimate, label, metrics, compared, entropy, notes, saved)
    if out is not None:
        RunDirectory(out.parent).write_json(out.name, evaluation.to_json())
    if compared is not None:
        for path in request.errors:
            write_errors(path, compared.comparison, compared.positions, request.errors_clip_m)
    if request.report and estimate.run is not None and request.out is None:
        from lidarslam.viewer.run_report import leave_report  # loads the pictures

        errors = MethodResult(str(estimate.run), "ok", trajectory=trajectory if in_camera else None, metrics=metrics)
        if compared is not None:
            errors = replace(errors, map_metrics=compared.json, map_errors=compared.errors)
        named = request.reference.name if isinstance(request.reference, Path) else GROUND_TRUTH
        leave_report(estimate.run, errors, named, notes)
    return evaluation


def _reference(request: EvaluateRequest, estimate: Estimate, notes: list[str]) -> Poses | None:
    """The reference trajectory; where a map is compared, its absence is only noted."""
    if request.reference is not None:
        return read_reference(request.reference, estimate.config.reader)
    if not request.needs_reference:
        return None
    try:
        return estimate.truth()
    except InputError as error:
        if request.reference_map is None:
            raise
        notes.append(f"the trajectory is not evaluated: {error}")
        return None


def _evaluate_map(
    request: EvaluateRequest, estimate: Estimate, metrics: TrajectoryMetrics | None, notes: list[str]
) -> MapEvaluation | None:
    """Errors of the map; None without a reference map, or without a map for that of the simulation."""
    reference = None
    if request.reference_map is not None:
        reference = load_reference_map(request.reference_map)
    elif request.needs_reference:
        sources = [path for path in (estimate.source, request.reference) if isinstance(path, Path) and path.exists()]
        reference = next((found for found in map(find_reference_map, sources) if found is not None), None)
        if reference is not None and estimate.map_file is None:
            if estimate.run is not None:
                notes.append("there is no map to compare with that of the simulation")
            return None
    return None if reference is None else evaluate_map(request, estimate, metrics, reference)


def evaluate_map(
    request: EvaluateRequest, estimate: Estimate, metrics: TrajectoryMetrics | None, reference: ReferenceMap
) -> MapEvaluation:
    """Compare the map of an estimate with a reference; the metrics are its trajectory's, None without a reference."""
    points = estimate.map_points()
    T_reference_world, positions = _along_trajectory(estimate, metrics, reference)
    alignment = _align(request, points, reference, T_reference_world)
    max_range_m = request.max_range_m or estimate.config.global_map.max_range_m
    positions = transform_points(alignment.T_reference_map, positions)
    aligned = transform_points(alignment.T_reference_map, points)
    comparison = compare_maps(aligned, reference.points, positions, max_range_m, request.spacing_m)
    label = f"{reference.path}{'' if reference.truth is None else ', the exact map of the simulation'}"
    return MapEvaluation(label, alignment, comparison, map_entropy(points), positions, max_range_m)


def _along_trajectory(
    estimate: Estimate, metrics: TrajectoryMetrics | None, reference: ReferenceMap
) -> tuple[FloatArray | None, FloatArray]:
    """`T_reference_world` (4, 4) by the trajectories, and the sensor's positions (K, 3) in the map's world.

    The positions are the true ones where there are any, as those of a lost trajectory are wrong.
    """
    trajectory, method = estimate.poses.trajectory, "se3" if metrics is None else metrics.alignment
    association = None if metrics is None else metrics.association
    T_reference_world = None if metrics is None else metrics.T_reference_estimate_joint
    if reference.truth is not None and estimate.poses.has_stamps:
        association = common_instants(trajectory, reference.truth)
        if association is not None:
            pair = association.estimate, association.reference
            T_reference_world = align_poses(*pair, align(*pair, method), method)
    if association is None or T_reference_world is None:
        return None, trajectory.positions
    return T_reference_world, transform_points(inverse(T_reference_world), association.reference.positions)


def _align(
    request: EvaluateRequest, points: FloatArray, reference: ReferenceMap, T_reference_world: FloatArray | None
) -> MapAlignment:
    by_trajectory = {} if T_reference_world is None else {"trajectory": T_reference_world}
    as_given, search = {"none": np.eye(4)}, request.map_alignment == GLOBAL
    match request.map_alignment:
        case "auto":
            search = reference.truth is None or not by_trajectory
            guesses = by_trajectory | as_given if search else by_trajectory
        case "global":
            guesses = {}
        case "trajectory":
            if not by_trajectory:
                raise InputError("--map-alignment trajectory needs a true trajectory in the reference map's world")
            guesses = by_trajectory
        case "none":
            guesses = as_given
        case file:
            guesses = {"file": read_transform(Path(file))}
    refine = request.map_alignment != "none" if request.refine is None else request.refine
    return align_map(points, reference.points, guesses, search, refine)


def check_error_files(paths: Sequence[Path]) -> None:
    """Refuse files that cannot be written later."""
    for path in paths:
        if path.suffix.lower() not in _SUFFIXES:
            raise OutputError(f"{path}: the errors can be written as {' or '.join(_SUFFIXES)}; name such a file")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent}; make it first")


def write_errors(path: Path, comparison: MapComparison, positions: FloatArray, clip_m: float) -> None:
    """Write the map coloured by its distance from the reference, in the reference's frame.

    A .ply file holds the points in double precision, with colours and distances. A .rrd file, for Rerun, also holds
    the reference coloured by its distance from the map, and the sensor's path (K, 3).
    """
    if path.suffix.lower() == ".rrd":
        from lidarslam.viewer.rerun_recording import save
        from lidarslam.viewer.rerun_scenes import show_errors

        save(show_errors(comparison, positions, clip_m), path)
        return
    errors = comparison.map_errors
    columns: Columns = dict(zip("xyz", errors.points.T, strict=True))
    columns |= zip(COLOURS, error_colours(errors.distances_m, clip_m).T, strict=True)
    columns[DISTANCE_FIELD] = errors.distances_m.astype(np.float32)
    with written(path) as partial:
        write_ply(partial, columns)


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
    if (entropy := evaluation.entropy) is not None:
        yield from ("", "MAP") if evaluation.map is None else ()
        yield _row("mean map entropy", f"{entropy.mean:>10.3f}      within {RADIUS_M:g} m; lower is crisper")
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
