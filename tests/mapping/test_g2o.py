"""g2o files: what is written is read again, by us and by GTSAM, and what is malformed is named."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse
from mapping.pose_graph.g2o import Edge, GraphFile, format_g2o, read_g2o

VERTICES = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nVERTEX_SE3:QUAT 2 2 0 0 0 0 0 1\n"
MOTION = "1 0 0 0 0 0 1"
# Upper triangle, translation first: x, y, z, then rotation about them.
UPPER = "100 0 0 0 0 7  25 0 0 0 0  4 0 0 0  400 0 0  900 0  1600"


def random_covariance(rng: np.random.Generator) -> FloatArray:
    A = rng.normal(size=(6, 6)) * np.array([0.01, 0.02, 0.03, 0.3, 0.2, 0.1])[:, None]
    return A @ A.T + np.diag([1e-5] * 3 + [1e-3] * 3)


@pytest.fixture
def graph(rng: np.random.Generator) -> GraphFile:
    """Poses turned every way, kilometres from the origin, with gaps between keys."""
    keys = np.array([0, 1, 5, 6, 1000])
    poses = exp(rng.normal(size=(5, 6)) * [1.0, 1.0, 1.0, 2000.0, 2000.0, 100.0])
    ends = [(0, 1), (1, 5), (5, 6), (1000, 6), (1000, 0), (5, 0)]
    kinds = ["refinement"] * 4 + ["loop"] * 2
    motions = exp(rng.normal(size=(6, 6)) * [1.0, 1.0, 1.0, 5.0, 5.0, 5.0])
    edges = tuple(
        Edge(*pair, motion, random_covariance(rng), kind)
        for pair, motion, kind in zip(ends, motions, kinds, strict=True)
    )
    return GraphFile(keys, poses, edges)


def written(folder: Path, text: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text(text, encoding="utf-8")
    return path


def assert_same(actual: GraphFile, expected: GraphFile, tolerance: float) -> None:
    assert actual.keys.dtype == np.int64
    np.testing.assert_array_equal(actual.keys, expected.keys)
    np.testing.assert_allclose(actual.poses, expected.poses, rtol=tolerance, atol=tolerance)
    assert len(actual.edges) == len(expected.edges)
    for one, other in zip(actual.edges, expected.edges, strict=True):
        assert (one.first, one.second, one.kind) == (other.first, other.second, other.kind)
        np.testing.assert_allclose(one.T_first_second, other.T_first_second, rtol=tolerance, atol=tolerance)
        scale = np.sqrt(np.outer(np.diag(other.covariance), np.diag(other.covariance)))
        np.testing.assert_allclose(one.covariance / scale, other.covariance / scale, atol=max(tolerance, 1e-9))


def test_what_is_written_is_read_again(graph: GraphFile, tmp_path: Path) -> None:
    assert_same(read_g2o(written(tmp_path, format_g2o(graph))), graph, 1e-12)


def test_gtsam_reads_what_is_written(graph: GraphFile, tmp_path: Path) -> None:
    factors, values = gtsam.readG2o(str(written(tmp_path, format_g2o(graph))), True)
    for key, pose in zip(graph.keys.tolist(), graph.poses, strict=True):
        np.testing.assert_allclose(values.atPose3(key).matrix(), pose, atol=1e-9)
    for row, edge in enumerate(graph.edges):
        factor = factors.at(row)
        assert list(factor.keys()) == [edge.first, edge.second]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_first_second, atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().covariance(), edge.covariance, rtol=1e-7, atol=1e-12)


def test_what_gtsam_writes_is_read(graph: GraphFile, tmp_path: Path) -> None:
    """GTSAM writes six digits."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, pose in zip(graph.keys.tolist(), graph.poses, strict=True):
        values.insert(key, gtsam.Pose3(pose))
    for edge in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        factors.add(gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.T_first_second), noise))
    path = tmp_path / "theirs.g2o"
    gtsam.writeG2o(factors, values, str(path))
    assert_same(read_g2o(path), graph, 1e-3)


def test_information_is_translation_first_in_the_file_and_rotation_first_here(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, f"{VERTICES}EDGE_SE3:QUAT 0 1 {MOTION} {UPPER}\n"))
    information = np.diag([400.0, 900.0, 1600.0, 100.0, 25.0, 4.0])
    information[2, 3] = information[3, 2] = 7.0  # of rotation about z with translation along x
    np.testing.assert_allclose(graph.edges[0].covariance, np.linalg.inv(information), atol=1e-15)


def test_quaternions_are_read_w_last_and_made_unit(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, "VERTEX_SE3:QUAT 3 1 2 3 0 0 2 2\n"))
    quarter = exp([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])
    quarter[:3, 3] = [1.0, 2.0, 3.0]
    np.testing.assert_allclose(graph.poses, quarter[None], atol=1e-15)
    assert graph.edges == ()


def test_vertices_may_stand_in_any_order_and_neighbours_are_refinements(tmp_path: Path) -> None:
    lines = [f"VERTEX_SE3:QUAT {key} {key} 0 0 0 0 0 1" for key in (7, 3, 4)]
    edges = [f"EDGE_SE3:QUAT {a} {b} {MOTION} {UPPER}" for a, b in ((3, 4), (7, 4), (3, 7))]
    graph = read_g2o(written(tmp_path, "\n".join(edges + lines)))
    assert graph.keys.tolist() == [3, 4, 7]
    np.testing.assert_array_equal(graph.poses[:, 0, 3], [3.0, 4.0, 7.0])
    assert [edge.kind for edge in graph.edges] == ["refinement", "refinement", "loop"]


def test_comments_blank_lines_and_fixed_vertices_are_skipped(tmp_path: Path) -> None:
    text = f"# a graph\n\nFIX 0\n{VERTICES}#EDGE\nEDGE_SE3:QUAT 0 2 {MOTION} {UPPER}\n"
    graph = read_g2o(written(tmp_path, text))
    assert len(graph.keys) == 3
    assert len(graph.edges) == 1


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("VERTEX_SE2 0 1 2 3", "VERTEX_SE2"),
        ("VERTEX_SE3:QUAT 4 0 0 0 0 0 0", "got 7"),
        ("VERTEX_SE3:QUAT 4 0 0 zero 0 0 0 1", "zero"),
        ("VERTEX_SE3:QUAT 4.5 0 0 0 0 0 0 1", "4.5"),
        ("VERTEX_SE3:QUAT -4 0 0 0 0 0 0 1", "-4"),
        (f"VERTEX_SE3:QUAT {2**63} 0 0 0 0 0 0 1", "9223372036854775808"),
        ("VERTEX_SE3:QUAT 4 0 0 nan 0 0 0 1", "nan"),
        ("VERTEX_SE3:QUAT 4 0 0 0 0 0 0 0", "quaternion"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1", "given before"),
        (f"EDGE_SE3:QUAT 0 1 {MOTION} 1 0 0", "got 12"),
        (f"EDGE_SE3:QUAT 0 3 {MOTION} {UPPER}", "joins 0 and 3"),
        (f"EDGE_SE3:QUAT 9 1 {MOTION} {UPPER}", "joins 9 and 1"),
        (f"EDGE_SE3:QUAT 1 1 {MOTION} {UPPER}", "joins 1 and 1"),
        (f"EDGE_SE3:QUAT 0 1 {MOTION} {UPPER.replace('1600', '-1')}", "positive definite"),
        (f"EDGE_SE3:QUAT 0 1 {MOTION} {UPPER.replace('900', '0')}", "positive definite"),
    ],
)
def test_a_malformed_line_is_named(line: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path, f"{VERTICES}{line}\n")
    with pytest.raises(InputError) as caught:
        read_g2o(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:4: ")
    assert words in message
    assert "\n" not in message


def test_a_file_that_is_missing_empty_or_no_text_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_g2o(tmp_path / "none.g2o")
    with pytest.raises(InputError, match="holds no pose"):
        read_g2o(written(tmp_path, "# nothing\n"))
    (tmp_path / "bytes.g2o").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        read_g2o(tmp_path / "bytes.g2o")


@pytest.mark.real_data
def test_a_real_graph_is_read_as_gtsam_reads_it(real_data: Path) -> None:
    path = real_data / "trajectories" / "parking-garage.g2o"
    if not path.is_file():
        pytest.skip(f"no {path.name} in the real data")
    graph = read_g2o(path)
    factors, values = gtsam.readG2o(str(path), True)
    assert (len(graph.keys), len(graph.edges)) == (1661, 6275)
    for key, pose in zip(graph.keys.tolist(), graph.poses, strict=True):
        np.testing.assert_allclose(values.atPose3(key).matrix(), pose, atol=1e-9)
    for row, edge in enumerate(graph.edges):
        found = factors.at(row).measured().matrix()
        np.testing.assert_allclose(inverse(found) @ edge.T_first_second, np.eye(4), atol=1e-9)
