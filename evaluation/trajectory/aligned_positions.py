"""A method's path in the world of the reference."""

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.trajectory.alignment import align
from lidarslam.core.geometry import FloatArray, inverse


def aligned_positions(method: MethodResult, sequence: SequenceComparison) -> FloatArray | None:
    """The method's positions (N, 3) in the reference's world: by SE(3) alignment where there are metrics, otherwise
    by the first pose, or in the frame of its first pose without a reference; None without a trajectory."""
    if method.trajectory is None or not len(method.trajectory):
        return None
    if method.metrics is not None:
        T_reference_estimate = method.metrics.T_reference_estimate
    elif sequence.reference is not None and len(sequence.reference):
        first = slice(0, 1)
        T_reference_estimate = align(method.trajectory.select(first), sequence.reference.select(first), "first_pose")
    else:
        T_reference_estimate = inverse(method.trajectory.T_world_lidar[0])
    return method.trajectory.transformed(T_reference_estimate).positions
