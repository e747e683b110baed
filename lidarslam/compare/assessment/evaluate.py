"""Evaluation of a run directory or a trajectory file: metrics.json."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lidarslam.compare.assessment.error_cloud import check_error_files, write_errors
from lidarslam.compare.assessment.evo_files import write_evo_files
from lidarslam.compare.assessment.inputs import Estimate, Poses, pair, read_estimate, read_reference, recording_truth
from lidarslam.compare.assessment.map_evaluation import MapEvaluation, MapOptions, evaluate_map
from lidarslam.compare.assessment.reference_map import find_reference_map, load_reference_map
from lidarslam.core.errors import InputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.map.entropy import MapEntropy, map_entropy
from lidarslam.evaluation.report.error_colours import DEFAULT_CLIP_M
from lidarslam.evaluation.trajectory.alignment import AlignmentMethod
from lidarslam.evaluation.trajectory.association import DEFAULT_MAX_GAP_S, DEFAULT_TOLERANCE_S
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics, disagreement, evaluate_trajectory, metrics_json
from lidarslam.storage import directory as files
from lidarslam.storage.directory import RunDirectory


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
    map_options: MapOptions = field(default_factory=MapOptions)  # of the comparison of maps
    errors: Sequence[Path] = ()  # files for the map coloured by its errors
    errors_clip_m: float = DEFAULT_CLIP_M  # distance of the brightest colour
    out: Path | None = None  # file for the figures; None: metrics.json of the run, and nothing of a bare trajectory
    needs_reference: bool = True  # whether it is an error that there is no reference
    evo: Path | None = None  # folder for the errors as files of evo; None: nowhere
    write: bool = True  # whether the figures are written
    report: bool = False  # whether the page of the run is drawn again, with the errors; not if the figures go elsewhere


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
    """Compare, and write the figures.

    Raises:
        InputError: a file is missing or damaged, or there is no reference.
        OutputError: a file cannot be written.
    """
    check_error_files(request.errors)
    estimate = read_estimate(request.run, request.map_file)
    notes: list[str] = []
    reference, metrics, trajectory = _reference(request, estimate, notes), None, None
    if reference is not None:
        trajectories = pair(estimate, reference)
        trajectory = trajectories[0]
        metrics = evaluate_trajectory(*trajectories, request.tolerance_s, request.max_gap_s, request.alignment)
        notes += [warning] if (warning := disagreement(metrics)) is not None else []
    # Poses of KITTI's camera do not give the LiDAR's world.
    in_camera = estimate.run is not None and reference is not None and reference.stamps is None
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
    written = [*([] if out is None else [out]), *request.errors]
    if request.evo is not None:
        written += _write_evo(request.evo, request.run, metrics)
    label = None if reference is None else reference.label
    evaluation = Evaluation(estimate, label, metrics, compared, entropy, notes, written)
    if out is not None:
        RunDirectory(out.parent).write_json(out.name, evaluation.to_json())
    if compared is not None:
        for path in request.errors:
            write_errors(path, compared.comparison, compared.positions, request.errors_clip_m)
    if request.report and estimate.run is not None and request.out is None:
        _draw_report(request, estimate.run, evaluation, trajectory if in_camera else None)
    return evaluation


def _write_evo(folder: Path, run: Path | Trajectory, metrics: TrajectoryMetrics | None) -> list[Path]:
    if metrics is None:
        raise InputError("--evo saves the errors of a trajectory, and there is no reference for it")
    return write_evo_files(folder, "estimate" if isinstance(run, Trajectory) else run.resolve().stem, metrics)


def _draw_report(request: EvaluateRequest, run: Path, evaluation: Evaluation, compared: Trajectory | None) -> None:
    """The page of the run with its errors; `compared` are the poses in the camera's frame, if they were compared."""
    from lidarslam.viewer.page.run_report import Accuracy, leave_report

    accuracy = Accuracy(
        evaluation.metrics,
        request.reference.name if isinstance(request.reference, Path) else "ground truth",
        compared,
        None if evaluation.map is None else evaluation.map.json,
        None if evaluation.map is None else evaluation.map.errors,
        tuple(evaluation.notes),
    )
    leave_report(run, accuracy)


def _reference(request: EvaluateRequest, estimate: Estimate, notes: list[str]) -> Poses | None:
    """The reference trajectory; where a map is compared, its absence is only noted."""
    if request.reference is not None:
        return read_reference(request.reference, estimate.config.reader)
    if not request.needs_reference:
        return None
    try:
        return _own_truth(estimate)
    except InputError as error:
        if request.reference_map is None:
            raise
        notes.append(f"the trajectory is not evaluated: {error}")
        return None


def _own_truth(estimate: Estimate) -> Poses:
    source, advice = estimate.source, "name a trajectory with --reference or a map with --reference-map"
    if source is None:
        raise InputError(f"{estimate.poses.label}: has no reference; {advice}")
    if not source.exists():
        raise InputError(f"{source}: the run's recording is not there any more; {advice}")
    return recording_truth(source, estimate.config.reader)


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
    return None if reference is None else evaluate_map(estimate, metrics, reference, request.map_options)
