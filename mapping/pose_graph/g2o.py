"""Pose graphs as g2o text, which GTSAM, g2o and Ceres read.

`VERTEX_SE3:QUAT key x y z qx qy qz qw` is a pose, `EDGE_SE3:QUAT first second x y z qx qy qz qw` followed by the upper
triangle of the information matrix, row by row, a relative pose. The information is translation first; here covariances
are rotation first. g2o measures rotation by the quaternion's vector part, half the angle; GTSAM and the tools around it
take the same numbers for the angle's, unscaled, and so does this file.

Not `gtsam.writeG2o`, whose six digits are a millimetre at a kilometre.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.loops.closure import RelativePose

_UPPER = np.triu_indices(6)
_TRANSLATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def format_g2o(poses: FloatArray, edges: Sequence[RelativePose]) -> str:
    """The graph of poses (N, 4, 4), whose keys are their rows, all digits written."""
    lines = [f"VERTEX_SE3:QUAT {key} {_text(_seven(T))}" for key, T in enumerate(poses)]
    for edge in edges:
        information = np.linalg.inv(edge.covariance)[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)]
        upper = (0.5 * (information + information.T))[_UPPER]
        lines.append(f"EDGE_SE3:QUAT {edge.first} {edge.second} {_text([*_seven(edge.T_first_second), *upper])}")
    return "".join(f"{line}\n" for line in lines)


def _seven(T: FloatArray) -> FloatArray:
    """x y z qx qy qz qw, qw >= 0."""
    from scipy.spatial.transform import Rotation  # takes a while to load

    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)
