"""A floor plan on a grid: corridors around blocks of rooms, what lies between them, and the way through."""

from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import left_of

WALL_M = 0.12
CORRIDOR, OUTSIDE, _UNKNOWN = 0, -1, -2
# The grid's columns and rows that can be corridors; the others are rooms. Nodes are where two of them cross.
_COLUMNS, _ROWS = (1, 4, 7), (1, 3, 5)
_LOOPS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((0, 0), (2, 0), (2, 2), (0, 2)),
    ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)),
    ((0, 0), (1, 0), (1, 2), (2, 2), (2, 1), (0, 1)),
    ((0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)),
)

Labels = npt.NDArray[np.int64]
Span = tuple[int, int]


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
        return left_of(self.direction)


@dataclass(frozen=True)
class Plan:
    """A floor plan."""

    loop: FloatArray  # (M, 2) corners of the closed way along the middle of the corridors
    corridors: tuple[Room, ...]  # overlapping where they cross
    rooms: dict[int, Room]  # by label
    walls: tuple[WallLine, ...]  # every wall once
    extent: FloatArray  # (2, 2) low and high corner of all


def draw_plan(rng: np.random.Generator) -> Plan:
    """A plan no two seeds share."""
    xs = _grid_lines(rng, "rcrrcrrcr", (2.7, 3.6))
    ys = _grid_lines(rng, "rcrcrcr", (3.3, 4.3))
    nodes = _loop_nodes(rng)
    labels = np.full((9, 7), _UNKNOWN)
    spans = _corridor_spans(nodes, rng)
    for (i0, i1), (j0, j1) in spans:
        labels[i0:i1, j0:j1] = CORRIDOR
    _label_rooms(labels, rng)

    def between(columns: Span, rows: Span) -> Room:
        return Room(np.array([xs[columns[0]], ys[rows[0]]]), np.array([xs[columns[1]], ys[rows[1]]]))

    cells = [between((_COLUMNS[i], _COLUMNS[i] + 1), (_ROWS[j], _ROWS[j] + 1)) for i, j in nodes]
    rooms = {}
    for label in range(1, int(labels.max()) + 1):
        i, j = np.nonzero(labels == label)
        if len(i):
            rooms[label] = between((i.min(), i.max() + 1), (j.min(), j.max() + 1))
    return Plan(
        loop=np.array([0.5 * (cell.low + cell.high) for cell in cells]),
        corridors=tuple(between(*span) for span in spans),
        rooms=rooms,
        walls=_walls(xs, ys, labels),
        extent=np.array([[xs[0], ys[0]], [xs[-1], ys[-1]]]),
    )


def _grid_lines(rng: np.random.Generator, kinds: str, block_m: tuple[float, float]) -> FloatArray:
    """Grid lines from the kinds of space between them: (r)oom or (c)orridor; the outer rooms are deeper."""
    sizes = [rng.uniform(1.6, 2.4) if kind == "c" else rng.uniform(*block_m) for kind in kinds]
    sizes[0], sizes[-1] = rng.uniform(3.6, 5.2, 2)
    return np.concatenate([[0.0], np.cumsum(sizes)])


def _loop_nodes(rng: np.random.Generator) -> list[tuple[int, int]]:
    """One of the loops, mirrored and turned round."""
    nodes = list(_LOOPS[int(rng.integers(len(_LOOPS)))])
    mirror_i, mirror_j, backwards = rng.random(3) < 0.5
    nodes = [(2 - i if mirror_i else i, 2 - j if mirror_j else j) for i, j in nodes]
    return nodes[::-1] if backwards else nodes


def _corridor_spans(nodes: list[tuple[int, int]], rng: np.random.Generator) -> list[tuple[Span, Span]]:
    """Cell ranges ((i0, i1), (j0, j1)) of the loop's corridors, and of side corridors that branch off."""
    legs = list(zip(nodes, nodes[1:] + nodes[:1], strict=True))
    for i, j in nodes:
        for other in ((1, j), (i, 1)):
            if other != (i, j) and rng.random() < 0.25:
                legs.append(((i, j), other))
    spans = set()
    for (i0, j0), (i1, j1) in legs:
        columns, rows = (_COLUMNS[i0], _COLUMNS[i1]), (_ROWS[j0], _ROWS[j1])
        spans.add(((min(columns), max(columns) + 1), (min(rows), max(rows) + 1)))
    return sorted(spans)


def _label_rooms(labels: Labels, rng: np.random.Generator) -> None:
    """Give every cell that is not corridor to a rectangular room; a room that touches no corridor lies outside."""
    label = 0
    for j in range(labels.shape[1]):
        for i in np.flatnonzero(labels[:, j] == _UNKNOWN):
            joins = i > 0 and labels[i - 1, j] > CORRIDOR and _may_join(int(i), rng)
            label += not joins
            labels[i, j] = label
    padded = np.pad(labels, 1, constant_values=OUTSIDE) == CORRIDOR
    touches = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    labels[(labels > CORRIDOR) & ~np.isin(labels, labels[touches])] = OUTSIDE


def _may_join(i: int, rng: np.random.Generator) -> bool:
    """Whether the cell in column i joins the one before: a corridor's column that is none always, others at times."""
    always = i in (_COLUMNS[0], _COLUMNS[1], _COLUMNS[2] + 1)
    return always or (i - 1 not in _COLUMNS and bool(rng.random() < 0.45))


def _walls(xs: FloatArray, ys: FloatArray, labels: Labels) -> tuple[WallLine, ...]:
    """A wall wherever two labels meet, as long as the two stay the same."""
    padded = np.pad(labels, 1, constant_values=OUTSIDE)
    walls: list[WallLine] = []
    for i, x in enumerate(xs):
        for j0, j1, pair in _runs(padded[i, 1:-1], padded[i + 1, 1:-1]):
            walls.append(WallLine(np.array([x, ys[j0]]), np.array([x, ys[j1]]), *pair))
    for j, y in enumerate(ys):
        for i0, i1, pair in _runs(padded[1:-1, j + 1], padded[1:-1, j]):
            walls.append(WallLine(np.array([xs[i0], y]), np.array([xs[i1], y]), *pair))
    return tuple(walls)


def _runs(left: Labels, right: Labels) -> list[tuple[int, int, tuple[int, int]]]:
    """Maximal runs (start, stop, pair) of equal pairs whose two labels differ."""
    runs, start = [], 0
    for pair, members in groupby(zip(left.tolist(), right.tolist(), strict=True)):
        stop = start + len(list(members))
        if pair[0] != pair[1]:
            runs.append((start, stop, pair))
        start = stop
    return runs
