"""A state is whole or absent, whatever happens while it is written, and damage is told."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.state import State
from lidarslam.storage.state_file import read_state, write_state

STATE: State = {
    "poses": np.linspace(0.0, 1.0, 32).reshape(2, 4, 4),
    "empty": np.empty((0, 3), dtype=np.float32),
    "deep": {"numbers": [0.1, float("inf"), -0.0], "rows": [{"keys": np.array([2**62])}, {"keys": None}]},
    "text": "größer\n",
    "on": True,
}


def assert_same(found: Any, expected: Any) -> None:
    assert type(found) is type(expected)
    if isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    elif isinstance(expected, dict):
        assert_same([*found, *found.values()], [*expected, *expected.values()])
    elif isinstance(expected, list):
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    else:
        assert found == expected


def test_a_state_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    write_state(tmp_path / "state.npz", STATE)
    assert_same(read_state(tmp_path / "state.npz")._values, STATE)
    assert [path.name for path in tmp_path.iterdir()] == ["state.npz"]


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_noticed_or_does_not_matter(tmp_path: Path, share: float, bit: int) -> None:
    path = tmp_path / "state.npz"
    write_state(path, STATE)
    content = bytearray(path.read_bytes())
    content[int(share * len(content))] ^= 1 << bit
    path.write_bytes(content)
    try:
        found = read_state(path)
    except InputError as error:
        assert "is damaged" in str(error)  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
        return
    assert_same(found._values, STATE)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.999])
def test_a_file_cut_short_is_damaged(tmp_path: Path, share: float) -> None:
    path = tmp_path / "state.npz"
    write_state(path, STATE)
    os.truncate(path, int(share * path.stat().st_size))
    with pytest.raises(InputError, match="is damaged"):
        read_state(path)


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_earlier_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    path = tmp_path / "state.npz"
    write_state(path, {"number": 1})

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os if step == "fsync" else Path, step, fail)
    with pytest.raises(OutputError, match="No space left"):
        write_state(path, {"number": 2})
    monkeypatch.undo()
    assert read_state(path).value("number") == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["state.npz"]
