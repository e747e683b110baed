"""Pose graphs <-> g2o text files, as GTSAM, g2o and Ceres exchange them.

`VERTEX_SE3:QUAT key x y z qx qy qz qw` is a pose, `EDGE_SE3:QUAT first second x y z qx qy qz qw` followed by the upper
triangle of the information matrix, row by row, a measured motion. The information is translation first; here everything
is rotation first.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.state import Saved, State, stack

EdgeKind = Literal["odometry", "refinement", "loop"]

_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_NUMBERS = {_VERTEX: (1, 7), _EDGE: (2, 28)}  # of keys, then of other numbers
_SKIPPED = {"FIX"}
_UPPER = np.triu_indices(6)
# Rotation first to translation first, and back.
# g2o itself measures rotation by the quaternion's vector part, half the angle, so its information on rotation is four
# times that on the angle. GTSAM and the tools around it take the same numbers for the angle's, unscaled; so do we.
_SWAP = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured motion between two poses.

    Attributes:
        first, second: keys of the poses.
        T_first_second: (4, 4) the second pose in the frame of the first.
        covariance: (6, 6) of xi in T_true = T_first_second @ exp(xi), rotation first.
        kind: what measured it.
    """

    first: int
    second: int
    T_first_second: FloatArray
    covariance: FloatArray
    kind: EdgeKind


def edges_state(edges: Sequence[Edge]) -> State:
    """All of several edges."""
    return {
        "ends": np.array([(edge.first, edge.second) for edge in edges], dtype=np.int64).reshape(-1, 2),
        "T_first_second": stack([edge.T_first_second for edge in edges], (4, 4)),
        "covariance": stack([edge.covariance for edge in edges], (6, 6)),
        "kind": [edge.kind for edge in edges],
    }


def restored_edges(saved: Saved) -> list[Edge]:
    """The edges with a state."""
    kinds = saved.texts("kind")
    if not set(kinds) <= set(get_args(EdgeKind)):
        raise saved.refuse(f"edges are of {set(kinds)}")
    ends = saved.array("ends", (len(kinds), 2), np.int64).tolist()
    T_first_second = saved.array("T_first_second", (len(kinds), 4, 4))
    covariance = saved.array("covariance", (len(kinds), 6, 6))
    return [
        Edge(first, second, T, C, cast(EdgeKind, kind))
        for (first, second), T, C, kind in zip(ends, T_first_second, covariance, kinds, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class GraphFile:
    """What a g2o file holds.

    Attributes:
        keys: (N,) int64, increasing.
        poses: (N, 4, 4) T_world_lidar.
        edges: in the order of the file.
    """

    keys: NDArray[np.int64]
    poses: FloatArray
    edges: tuple[Edge, ...]


@dataclass(frozen=True)
class _Line:
    """A line's numbers, and where it stands."""

    place: str
    keys: tuple[int, ...]
    numbers: tuple[float, ...]


def read_g2o(path: Path | str) -> GraphFile:
    """Read a pose graph; the file does not say what measured an edge.

    An edge between neighbours in the order of keys is taken for a `refinement`, any other for a `loop`. Lines that fix
    a vertex, comments and blank lines are skipped.

    Raises:
        InputError: the file is missing, a line is malformed or of another kind, or keys do not fit together.
    """
    lines = _parse(Path(path))
    vertices = sorted(lines[_VERTEX], key=lambda line: line.keys)
    keys = np.array([line.keys[0] for line in vertices], dtype=np.int64)
    for line, twin in zip(vertices[1:], keys[:-1], strict=True):
        if line.keys[0] == twin:
            raise InputError(f"{line.place}: vertex {twin} was given before; each key stands for one pose")
    return GraphFile(keys, _transforms(vertices), _edges(lines[_EDGE], keys))


def format_g2o(graph: GraphFile) -> str:
    """The graph as g2o text, numbers to their last digit; what measured an edge is not written."""
    out = StringIO()
    for key, numbers in zip(graph.keys, _seven(graph.poses).tolist(), strict=True):
        out.write(f"{_VERTEX} {key} {_text(numbers)}\n")
    if not graph.edges:
        return out.getvalue()
    motions = _seven(np.stack([edge.T_first_second for edge in graph.edges]))
    information = np.linalg.inv(np.stack([edge.covariance for edge in graph.edges]))[:, _SWAP[:, None], _SWAP]
    upper = (0.5 * (information + information.mT))[:, _UPPER[0], _UPPER[1]]
    for edge, numbers in zip(graph.edges, np.hstack([motions, upper]).tolist(), strict=True):
        out.write(f"{_EDGE} {edge.first} {edge.second} {_text(numbers)}\n")
    return out.getvalue()


def _parse(path: Path) -> dict[str, list[_Line]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
    lines: dict[str, list[_Line]] = {_VERTEX: [], _EDGE: []}
    for number, line in enumerate(text.splitlines(), start=1):
        tag, *words = line.split() or ["#"]
        if tag in lines:
            lines[tag].append(_parse_line(f"{path}:{number}", tag, words))
        elif tag not in _SKIPPED and not tag.startswith("#"):
            raise InputError(
                f"{path}:{number}: expected {_VERTEX} or {_EDGE}, got {tag[:40]!r}; only 3D poses are read"
            )
    if not lines[_VERTEX]:
        raise InputError(f"{path}: holds no pose; expected lines `{_VERTEX} key x y z qx qy qz qw`")
    return lines


def _parse_line(place: str, tag: str, words: Sequence[str]) -> _Line:
    keys, numbers = _NUMBERS[tag]
    expected = f"{place}: expected {tag} with {keys} whole and {numbers} other finite numbers, got"
    if len(words) != keys + numbers:
        raise InputError(f"{expected} {len(words)}")
    try:
        line = _Line(place, tuple(map(int, words[:keys])), tuple(map(float, words[keys:])))
    except ValueError:
        raise InputError(f"{expected} {' '.join(words)[:60]!r}") from None
    if not np.isfinite(line.numbers).all() or not all(0 <= key < 2**63 for key in line.keys):
        raise InputError(f"{expected} {' '.join(words)[:60]!r}")
    if not sum(number**2 for number in line.numbers[3:7]):
        raise InputError(f"{place}: its quaternion is zero; write 0 0 0 1 for no rotation")
    return line


def _edges(lines: Sequence[_Line], keys: NDArray[np.int64]) -> tuple[Edge, ...]:
    if not lines:
        return ()
    ends = np.array([line.keys for line in lines], dtype=np.int64)
    rows = np.searchsorted(keys, ends).clip(max=len(keys) - 1)
    for line, missing in zip(lines, keys[rows] != ends, strict=True):
        if missing.any() or line.keys[0] == line.keys[1]:
            raise InputError(f"{line.place}: joins {line.keys[0]} and {line.keys[1]}; expected two different vertices")
    neighbours = np.abs(rows[:, 1] - rows[:, 0]) == 1
    covariances = _covariances(lines)
    return tuple(
        Edge(line.keys[0], line.keys[1], T_first_second, covariance, "refinement" if neighbour else "loop")
        for line, T_first_second, covariance, neighbour in zip(
            lines, _transforms(lines), covariances, neighbours, strict=True
        )
    )


def _covariances(lines: Sequence[_Line]) -> FloatArray:
    """(E, 6, 6) rotation first."""
    information = np.zeros((len(lines), 6, 6))
    information[:, _UPPER[0], _UPPER[1]] = np.array([line.numbers[7:] for line in lines])
    information += np.triu(information, 1).mT
    for line, least in zip(lines, np.linalg.eigvalsh(information)[:, 0], strict=True):
        if least <= 0.0:
            raise InputError(f"{line.place}: its information matrix is not positive definite, so it has no covariance")
    covariances = np.linalg.inv(information)[:, _SWAP[:, None], _SWAP]
    return np.asarray(0.5 * (covariances + covariances.mT), dtype=np.float64)


def _transforms(lines: Sequence[_Line]) -> FloatArray:
    table = np.array([line.numbers[:7] for line in lines])
    return make_transform(Rotation.from_quat(table[:, 3:]).as_matrix(), table[:, :3])


def _seven(T: FloatArray) -> FloatArray:
    """(N, 7) x y z qx qy qz qw, qw >= 0."""
    return np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)])


def _text(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)
