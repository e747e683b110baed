"""Saved state: what was saved comes back equal, other types and shapes are refused, a file is whole or absent."""

import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Shape, Stateful, read_state, write_state


class Colour(Enum):
    RED = 1
    BLUE = 2


@dataclass(frozen=True, eq=False)
class Pose:
    T_world_lidar: Annotated[FloatArray, Shape(4, 4)]
    number: int
    weight: float | None


class Grid(Stateful):
    cell_m: float
    keys: NDArray[np.int64]
    LEVELS: ClassVar[int] = 3

    def __init__(self, cell_m: float) -> None:
        self.cell_m, self.keys = cell_m, np.arange(int(cell_m))
        self.count = len(self.keys)

    def _after_restore(self) -> None:
        self.count = len(self.keys)


class Everything(Stateful):
    grid: Grid
    spare: Grid | None
    grids: list[Grid]
    poses: list[Pose]
    arrays: list[FloatArray]
    covariances: list[Annotated[FloatArray, Shape(2, 2)] | None]
    uneven: list[FloatArray]
    times: dict[str, float]
    colour: Colour
    colours: list[Colour]
    pair: tuple[int, float]
    images: NDArray[np.float16]
    names: list[str]

    def __init__(self, full: bool) -> None:
        self.grid, self.spare = Grid(3.0 if full else 1.0), Grid(2.0) if full else None
        self.grids = [Grid(4.0), Grid(5.0)] if full else []
        self.poses = [Pose(np.eye(4), 1, None), Pose(2 * np.eye(4), 2, 0.1)] if full else []
        self.arrays = [np.eye(3), np.zeros((3, 3))] if full else []
        self.covariances = [None, np.eye(2), None] if full else []
        self.uneven = [np.zeros(2), np.ones(3)] if full else []
        self.times = {"read": 1.0, "map": 1.0 / 3.0} if full else {}
        self.colour, self.colours = (Colour.BLUE, [Colour.BLUE, Colour.RED]) if full else (Colour.RED, [])
        self.pair = (4, 0.1) if full else (0, 0.0)
        self.images = np.ones((2, 2) if full else (0, 2), np.float16)
        self.names = ["é", "\n"] if full else []
        self.setting = full


@pytest.mark.parametrize("full", [False, True])
def test_what_was_saved_comes_back(full, tmp_path):
    saved, restored = Everything(full), Everything(not full)
    grid = restored.grid
    write_state(tmp_path / "state.npz", saved.state())
    restored.restore(read_state(tmp_path / "state.npz"))
    assert_equal({**vars(saved), "setting": not full}, vars(restored))
    assert restored.grid is grid  # restored in place
    write_state(tmp_path / "again.npz", restored.state())
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "state.npz").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: tree["covariances"].update(values=np.zeros((1, 3, 3))), "expected an array of float64"),
        (lambda tree: tree["grid"].update(keys=np.zeros(3)), "expected an array of int64, got float64"),
    ],
)
def test_other_types_and_shapes_are_refused(change, message):
    tree: Any = Everything(True).state()
    change(tree)
    with pytest.raises(InputError, match=message):
        Everything(False).restore(tree)


@pytest.mark.parametrize("flips", [True, False])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.7])
def test_a_damaged_file_is_told(tmp_path, share, flips):
    path = tmp_path / "state.npz"
    write_state(path, {"poses": np.linspace(0.0, 1.0, 1600)})
    content = bytearray(path.read_bytes())
    at = int(share * len(content))
    content[at] ^= 0xFF
    path.write_bytes(content if flips else content[:at])
    with pytest.raises(InputError, match="is damaged"):
        read_state(path)


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_earlier_state(tmp_path, monkeypatch, step):
    path = tmp_path / "state.npz"
    write_state(path, {"number": 1})

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os if step == "fsync" else Path, step, fail)
    with pytest.raises(OutputError, match="No space left"):
        write_state(path, {"number": 2})
    monkeypatch.undo()
    assert read_state(path)["number"] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["state.npz"]


def assert_equal(one: Any, other: Any) -> None:
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert_equal(value, other[name])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for value, found in zip(one, other, strict=True):
            assert_equal(value, found)
    elif isinstance(one, Pose | Grid):
        assert_equal(vars(one), vars(other))
    else:
        assert one == other
