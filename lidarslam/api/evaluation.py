"""Evaluation of a trajectory and its map relative to references."""

from os import PathLike
from pathlib import Path
from typing import Any

from lidarslam.assessment.evaluate import EvaluateRequest
from lidarslam.assessment.evaluate import evaluate as evaluate_request
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import AlignmentMethod

Source = str | PathLike[str] | Trajectory


def evaluate(
    estimate: Source,
    reference: Source | None = None,
    *,
    reference_map: str | PathLike[str] | None = None,
    alignment: AlignmentMethod = "se3",
) -> dict[str, Any]:
    """The errors of a trajectory, and of its map where there is a reference for it: the content of metrics.json.

    Nothing is written. Errors that cannot be computed are None.

    Args:
        estimate: a trajectory; the path of one in TUM or KITTI text; or a run directory.
        reference: likewise, or the path of a recording with ground truth; None: the ground truth that came with the
            recording of the run.
        reference_map: the path of a point cloud to compare the map with.
        alignment: of the trajectory, for the absolute errors.

    Raises:
        InputError: a file is missing or damaged, there is no reference, or the two have no instant in common.
    """
    request = EvaluateRequest(
        _trajectory_or_path(estimate),
        None if reference is None else _trajectory_or_path(reference),
        None if reference_map is None else Path(reference_map),
        alignment=alignment,
        write=False,
    )
    return evaluate_request(request).to_json()


def _trajectory_or_path(source: Source) -> Trajectory | Path:
    return source if isinstance(source, Trajectory) else Path(source)
