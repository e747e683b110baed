"""Errors of the methods' trajectories and maps on a recording, against its reference."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lidarslam.assessment.inputs import find_reference_map, load_reference_map, read_estimate
from lidarslam.assessment.map_evaluation import evaluate_map
from lidarslam.compare.peers.scene import scene_note
from lidarslam.compare.plan import PlannedRecording
from lidarslam.core.errors import InputError
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.evaluation.comparison.comparison import GROUND_TRUTH, MethodResult, SequenceComparison
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory


def measure(planned: PlannedRecording, results: Sequence[MethodResult], with_maps: bool = True) -> SequenceComparison:
    """The results on one recording, one per method, with the errors of trajectories and, if asked for, of maps."""
    notes = [] if planned.range_m is None else [scene_note(planned.range_m)]
    reference = _find_reference(planned, results, notes)
    measured = [_measure_trajectory(result, reference) for result in results]
    if with_maps:
        measured = _measure_maps(planned, measured, notes)
    return SequenceComparison(
        sequence=planned.name,
        source=str(planned.source),
        reference=reference,
        reference_name=planned.entry.reference or GROUND_TRUTH,
        methods=measured,
        notes=notes,
    )


def _find_reference(planned: PlannedRecording, results: Sequence[MethodResult], notes: list[str]) -> Trajectory | None:
    """The trajectory of a method or a file, or the ground truth; why there is none is added to the notes."""
    wanted = planned.entry.reference
    method = next((result for result in results if result.name == wanted), None)
    if method is not None and method.trajectory is not None:
        notes.append(f"errors are differences from {method.name}, which is no truth and has none itself")
        return method.trajectory
    if method is not None:
        notes.append(f"no errors are given: {method.name}, the reference, {method.status}")
        return None
    try:
        reference = planned.recording.ground_truth if wanted is None else read_tum(Path(wanted))
    except InputError as error:
        notes.append(f"no errors are given: {error}")
        return None
    if reference is None:
        why = "the recording came without ground truth; name a method or a file with --reference"
        notes.append(f"no errors are given: {why}")
    return reference


def _measure_trajectory(result: MethodResult, reference: Trajectory | None) -> MethodResult:
    if result.trajectory is None or reference is None or result.trajectory is reference:
        return result
    try:
        return replace(result, metrics=evaluate_trajectory(result.trajectory, reference))
    except InputError as error:
        return replace(result, message="; ".join(filter(None, [result.message, f"no errors are given: {error}"])))


def _measure_maps(planned: PlannedRecording, results: Sequence[MethodResult], notes: list[str]) -> list[MethodResult]:
    """Compare every map with the reference map; remarks are added to the notes."""
    try:
        file = planned.entry.reference_map
        reference = find_reference_map(planned.source) if file is None else load_reference_map(file)
    except InputError as error:
        notes.append(f"no map is compared: {error}")
        return list(results)
    folders = {run.name: run.request.out for run in planned.runs}
    is_method = planned.entry.reference in folders  # whose world is not the reference map's
    measured = []
    for result in results:
        measured.append(result)
        if reference is None or result.trajectory is None:
            continue
        try:
            compared = evaluate_map(
                read_estimate(folders[result.name]), None if is_method else result.metrics, reference
            )
        except InputError as error:
            notes.append(f"{result.name}: no map is compared: {error}")
            continue
        notes.extend(f"{result.name}: {warning}" for warning in compared.warnings())
        measured[-1] = replace(result, map_metrics=compared.json, map_errors=compared.errors)
    return measured
