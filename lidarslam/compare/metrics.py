"""What the methods' results on a recording are held against, and how far they are from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.compare.plan import PlannedRecording
from lidarslam.core.errors import InputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_tum
from lidarslam.evaluate.inputs import read_estimate
from lidarslam.evaluate.map_evaluation import evaluate_map
from lidarslam.evaluate.reference_map import ReferenceMap, find_reference_map, load_reference_map

GROUND_TRUTH = "ground truth"


@dataclass(frozen=True, eq=False)
class _Reference:
    """What trajectories are held against: its name, the poses if there are any, and what is to be said of it."""

    name: str
    trajectory: Trajectory | None
    notes: tuple[str, ...] = ()


def measure(planned: PlannedRecording, results: Sequence[MethodResult], with_maps: bool = True) -> SequenceComparison:
    """The results on one recording, with their errors.

    Args:
        planned: the recording.
        results: one a method.
        with_maps: whether maps are held against the reference map, if there is one.
    """
    reference = _find_reference(planned, results)
    measured = [_measure_trajectory(result, reference) for result in results]
    notes = list(reference.notes)
    if with_maps:
        measured = _measure_maps(planned, measured, notes)
    return SequenceComparison(
        sequence=planned.name,
        source=str(planned.entry.source),
        reference=reference.trajectory,
        reference_name=reference.name,
        methods=measured,
        notes=notes,
    )


def _find_reference(planned: PlannedRecording, results: Sequence[MethodResult]) -> _Reference:
    wanted = planned.entry.reference
    method = next((result for result in results if result.name == wanted), None)
    if method is not None:
        return _method_as_reference(method)
    try:
        if wanted is not None:
            return _Reference(wanted, read_tum(Path(wanted)))
        truth = planned.recording.ground_truth
    except InputError as error:
        return _Reference(wanted or GROUND_TRUTH, None, (f"no errors are given: {error}",))
    if truth is None:
        why = "the recording came without ground truth; name a method or a file with --reference"
        return _Reference(GROUND_TRUTH, None, (f"no errors are given: {why}",))
    return _Reference(GROUND_TRUTH, truth)


def _method_as_reference(method: MethodResult) -> _Reference:
    if method.trajectory is None:
        return _Reference(method.name, None, (f"no errors are given: {method.name}, the reference, {method.status}",))
    said = f"errors are differences from {method.name}, which is no truth and has none itself"
    return _Reference(method.name, method.trajectory, (said,))


def _measure_trajectory(result: MethodResult, reference: _Reference) -> MethodResult:
    if result.trajectory is None or reference.trajectory is None or result.trajectory is reference.trajectory:
        return result
    try:
        return replace(result, metrics=evaluate_trajectory(result.trajectory, reference.trajectory))
    except InputError as error:
        return replace(result, message="; ".join(filter(None, [result.message, f"no errors are given: {error}"])))


def _measure_maps(planned: PlannedRecording, results: Sequence[MethodResult], notes: list[str]) -> list[MethodResult]:
    """Hold every map against the reference map; what is to be said of it is added to the notes."""
    try:
        file = planned.entry.reference_map
        reference = find_reference_map(planned.entry.source) if file is None else load_reference_map(file)
    except InputError as error:
        notes.append(f"no map is compared: {error}")
        return list(results)
    if reference is None:
        return list(results)
    folders = {task.name: task.run.out for task in planned.tasks}
    is_method = planned.entry.reference in folders  # whose world is not the reference map's
    return [_measure_map(result, folders[result.name], reference, is_method, notes) for result in results]


def _measure_map(
    result: MethodResult, folder: Path, reference: ReferenceMap, by_map_alone: bool, notes: list[str]
) -> MethodResult:
    if result.trajectory is None:
        return result
    try:
        evaluation = evaluate_map(read_estimate(folder), None if by_map_alone else result.metrics, reference)
    except InputError as error:
        notes.append(f"{result.name}: no map is compared: {error}")
        return result
    notes.extend(f"{result.name}: {warning}" for warning in evaluation.warnings())
    return replace(result, map_metrics=evaluation.json, map_errors=evaluation.errors)
