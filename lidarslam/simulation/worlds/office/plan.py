"""A floor plan on a grid: corridors around blocks of rooms, what lies between them, and the way through."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarslam.core.geometry import FloatArray

CORRIDOR, OUTSIDE, UNKNOWN = 0, -1, -2
# The grid's columns and rows that can be corridors; the others are rooms. Nodes are where two of them cross.
CORRIDOR_COLUMNS, CORRIDOR_ROWS = (1, 4, 7), (1, 3, 5)
LOOPS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((0, 0), (2, 0), (2, 2), (0, 2)),
    ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)),
    ((0, 0), (1, 0), (1, 2), (2, 2), (2, 1), (0, 1)),
    ((0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)),
)


@dataclass(frozen=True)
class Room:
    """A rectangular room between the middle lines of its walls, (2,) corners low and high."""

    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class WallLine:
    """A straight wall's middle line from a to b (2,), and the labels to its left and right, seen from a to b."""

    a: FloatArray
    b: FloatArray
    left: int
    right: int

    @property
    def length(self) -> float:
        """Distance from a to b."""
        return float(np.linalg.norm(self.b - self.a))

    @property
    def direction(self) -> FloatArray:
        """(2,) unit vector from a to b."""
        return np.asarray((self.b - self.a) / self.length)

    @property
    def to_left(self) -> FloatArray:
        """(2,) unit vector to the left of the direction."""
        return np.array([-self.direction[1], self.direction[0]])


@dataclass(frozen=True)
class Plan:
    """What is where.

    Attributes:
        loop: (M, 2) corners of the closed way along the middle of the corridors.
        corridors: corridor rectangles, overlapping where they cross.
        rooms: by label.
        walls: every wall once.
        extent: (2, 2) low and high corner of all.
    """

    loop: FloatArray
    corridors: tuple[Room, ...]
    rooms: dict[int, Room]
    walls: tuple[WallLine, ...]
    extent: FloatArray


def draw_plan(rng: np.random.Generator) -> Plan:
    """A plan no two seeds share."""
    xs = _grid_lines(rng, "rcrrcrrcr", (2.7, 3.6))
    ys = _grid_lines(rng, "rcrcrcr", (3.3, 4.3))
    nodes = _loop_nodes(rng)
    labels = np.full((9, 7), UNKNOWN)
    spans = _corridor_spans(nodes, rng)
    for (i0, i1), (j0, j1) in spans:
        labels[i0:i1, j0:j1] = CORRIDOR
    _label_rooms(labels, rng)
    loop = np.array([[_middle(xs, CORRIDOR_COLUMNS[i]), _middle(ys, CORRIDOR_ROWS[j])] for i, j in nodes])
    corridors = tuple(Room(np.array([xs[i0], ys[j0]]), np.array([xs[i1], ys[j1]])) for (i0, i1), (j0, j1) in spans)
    rooms = {}
    for label in range(1, int(labels.max()) + 1):
        i, j = np.nonzero(labels == label)
        if len(i):
            rooms[label] = Room(np.array([xs[i.min()], ys[j.min()]]), np.array([xs[i.max() + 1], ys[j.max() + 1]]))
    extent = np.array([[xs[0], ys[0]], [xs[-1], ys[-1]]])
    return Plan(loop, corridors, rooms, _walls(xs, ys, labels), extent)


def _grid_lines(rng: np.random.Generator, kinds: str, block_m: tuple[float, float]) -> FloatArray:
    """Grid lines from the kinds of what lies between them: (r)oom or (c)orridor; the outer rooms are deeper."""
    sizes = [rng.uniform(1.6, 2.4) if kind == "c" else rng.uniform(*block_m) for kind in kinds]
    sizes[0], sizes[-1] = rng.uniform(3.6, 5.2, 2)
    return np.concatenate([[0.0], np.cumsum(sizes)])


def _middle(lines: FloatArray, k: int) -> float:
    return float(0.5 * (lines[k] + lines[k + 1]))


def _loop_nodes(rng: np.random.Generator) -> list[tuple[int, int]]:
    """One of the loops, mirrored and turned round."""
    nodes = list(LOOPS[int(rng.integers(len(LOOPS)))])
    mirror_i, mirror_j, backwards = rng.random(3) < 0.5
    nodes = [(2 - i if mirror_i else i, 2 - j if mirror_j else j) for i, j in nodes]
    return nodes[::-1] if backwards else nodes


def _corridor_spans(
    nodes: list[tuple[int, int]], rng: np.random.Generator
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Cell ranges ((i0, i1), (j0, j1)) of the loop's corridors, and of side corridors that branch off."""
    legs = list(zip(nodes, nodes[1:] + nodes[:1], strict=True))
    for i, j in nodes:
        for other in ((1, j), (i, 1)):
            if other != (i, j) and rng.random() < 0.25:
                legs.append(((i, j), other))
    spans = set()
    for (i0, j0), (i1, j1) in legs:
        columns = sorted((CORRIDOR_COLUMNS[i0], CORRIDOR_COLUMNS[i1]))
        rows = sorted((CORRIDOR_ROWS[j0], CORRIDOR_ROWS[j1]))
        spans.add(((columns[0], columns[1] + 1), (rows[0], rows[1] + 1)))
    return sorted(spans)


def _label_rooms(labels: npt.NDArray[np.int64], rng: np.random.Generator) -> None:
    """Give every cell that is not corridor to a rectangular room; what touches no corridor lies outside."""
    label = 0
    for j in range(labels.shape[1]):
        row = [i for i in range(labels.shape[0]) if labels[i, j] == UNKNOWN]
        for i in row:
            joins = i > 0 and labels[i - 1, j] > CORRIDOR and _may_join(i, rng)
            if not joins:
                label += 1
            labels[i, j] = label
    for known in range(1, label + 1):
        cells = np.argwhere(labels == known)
        if not any(_touches_corridor(labels, i, j) for i, j in cells):
            labels[labels == known] = OUTSIDE


def _may_join(i: int, rng: np.random.Generator) -> bool:
    """Whether the cell in column i joins the one before: a corridor's column that is none always, others at times."""
    always = i == CORRIDOR_COLUMNS[0] or i in (CORRIDOR_COLUMNS[1], CORRIDOR_COLUMNS[2] + 1)
    return always or (i - 1 not in CORRIDOR_COLUMNS and bool(rng.random() < 0.45))


def _touches_corridor(labels: npt.NDArray[np.int64], i: int, j: int) -> bool:
    near = ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
    return any(0 <= a < labels.shape[0] and 0 <= b < labels.shape[1] and labels[a, b] == CORRIDOR for a, b in near)


def _walls(xs: FloatArray, ys: FloatArray, labels: npt.NDArray[np.int64]) -> tuple[WallLine, ...]:
    """A wall wherever two labels meet, as long as the two stay the same."""
    padded = np.pad(labels, 1, constant_values=OUTSIDE)
    walls: list[WallLine] = []
    for i, x in enumerate(xs):
        pairs = [(int(padded[i, j + 1]), int(padded[i + 1, j + 1])) for j in range(len(ys) - 1)]
        walls += [WallLine(np.array([x, ys[j0]]), np.array([x, ys[j1]]), *pair) for j0, j1, pair in _runs(pairs)]
    for j, y in enumerate(ys):
        pairs = [(int(padded[i + 1, j + 1]), int(padded[i + 1, j])) for i in range(len(xs) - 1)]
        walls += [WallLine(np.array([xs[i0], y]), np.array([xs[i1], y]), *pair) for i0, i1, pair in _runs(pairs)]
    return tuple(walls)


def _runs(pairs: list[tuple[int, int]]) -> list[tuple[int, int, tuple[int, int]]]:
    """Maximal runs (start, stop, pair) of equal pairs whose two labels differ."""
    runs: list[tuple[int, int, tuple[int, int]]] = []
    for k, pair in enumerate(pairs):
        if pair[0] == pair[1]:
            continue
        if runs and runs[-1][1] == k and runs[-1][2] == pair:
            runs[-1] = (runs[-1][0], k + 1, pair)
        else:
            runs.append((k, k + 1, pair))
    return runs
