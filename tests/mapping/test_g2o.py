"""g2o text that is written is what GTSAM reads."""

import gtsam
import numpy as np

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.mapping.loops.closure import RelativePose
from lidarslam.mapping.pose_graph.correction import format_g2o


def random_covariance(rng: np.random.Generator) -> FloatArray:
    A = rng.normal(size=(6, 6)) * np.array([0.01, 0.02, 0.03, 0.3, 0.2, 0.1])[:, None]
    return A @ A.T + np.diag([1e-5] * 3 + [1e-3] * 3)


def test_gtsam_reads_what_is_written(rng, tmp_path):
    """Poses turned every way, kilometres from the origin, to the last digits."""
    poses = exp(rng.normal(size=(5, 6)) * [1.0, 1.0, 1.0, 2000.0, 2000.0, 100.0])
    motions = exp(rng.normal(size=(6, 6)) * [1.0, 1.0, 1.0, 5.0, 5.0, 5.0])
    ends = [(0, 1), (1, 2), (2, 3), (4, 3), (4, 0), (2, 0)]
    edges = [RelativePose(*pair, T, random_covariance(rng)) for pair, T in zip(ends, motions, strict=True)]
    path = tmp_path / "graph.g2o"
    path.write_text(format_g2o(poses, edges), encoding="utf-8")
    factors, values = gtsam.readG2o(str(path), True)
    assert (factors.size(), values.size()) == (6, 5)
    for key, pose in enumerate(poses):
        np.testing.assert_allclose(values.atPose3(key).matrix(), pose, atol=1e-9)
    for row, edge in enumerate(edges):
        factor = factors.at(row)
        assert list(factor.keys()) == [edge.first, edge.second]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_first_second, atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().covariance(), edge.covariance, rtol=1e-7, atol=1e-12)


def test_information_is_translation_first_in_the_file():
    covariance = np.diag([1 / 400, 1 / 900, 1 / 1600, 1 / 100, 1 / 25, 1 / 4])
    _, line = format_g2o(np.eye(4)[None], [RelativePose(0, 1, np.eye(4), covariance)]).splitlines()
    tag, first, second, *numbers = line.split()
    assert (tag, first, second) == ("EDGE_SE3:QUAT", "0", "1")
    assert [float(number) for number in numbers[:7]] == [0, 0, 0, 0, 0, 0, 1]
    upper = np.array([float(number) for number in numbers[7:]])
    np.testing.assert_allclose(upper[[0, 6, 11, 15, 18, 20]], [100, 25, 4, 400, 900, 1600])
