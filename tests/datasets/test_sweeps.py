"""Scans that hold a part of a sweep are joined to sweeps."""

import json
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording

from ..conftest import succeeds, write_recording

PARTS, PERIOD_S = 5, 0.02
JOINED = "every 5 scans are joined to one sweep of 0.1 s"


def opened(folder: Path, scans: Iterable[Scan], **settings: object) -> Recording:
    return open_recording(write_recording(folder, scans, is_timed=True), ReaderConfig(mounting="upright", **settings))


def parts_of(turn: Scan) -> list[Scan]:
    """A turn as messages of a fifth each, stamped at their first point."""
    edges = np.linspace(0, len(turn), PARTS + 1).astype(int)
    parts = [turn.select(np.arange(first, end)) for first, end in pairwise(edges)]
    return [
        replace(part, stamp=turn.stamp + at, time_offsets=part.time_offsets - at)
        for part in parts
        for at in [float(part.time_offsets[0])]
    ]


@pytest.fixture(scope="module")
def turns(room, drive, room_truth) -> list[Scan]:
    return [room.ring_sweep(drive, float(stamp), rings=16) for stamp in room_truth.stamps[:6]]


@pytest.fixture(scope="module")
def parts(turns) -> list[Scan]:
    return [part for turn in turns for part in parts_of(turn)]


def sparse(rng: np.random.Generator, count: int, spacing_deg: float = 0.0) -> list[Scan]:
    """Scans of 800 points in random directions, or in the same directions every time."""
    fixed = rng.uniform(-1.0, 1.0, (800, 3))
    times = np.linspace(0.0, PERIOD_S, 800)
    clouds = (fixed if spacing_deg else rng.uniform(-1.0, 1.0, (800, 3)) for _ in range(count))
    return [Scan(5.0 * cloud, 100.0 + PERIOD_S * number, times) for number, cloud in enumerate(clouds)]


def assert_same(sweep: Scan, turn: Scan) -> None:
    np.testing.assert_array_equal(sweep.points, turn.points)
    np.testing.assert_array_equal(sweep.rings, turn.rings)
    np.testing.assert_allclose(sweep.stamp + sweep.time_offsets, turn.stamp + turn.time_offsets, atol=1e-8)


def test_parts_of_a_turn_become_the_turn(tmp_path, turns, parts):
    recording = opened(tmp_path / "parts", parts)
    assert len(recording) == len(turns)
    for sweep, turn in zip(recording.scans(), turns, strict=True):
        assert_same(sweep, turn)
    assert [sweep.stamp for sweep in recording.scans(1, 6, 2)] == [sweep.stamp for sweep in recording.scans()][1::2]
    assert_same(next(recording.scans(3)), turns[3])
    described = recording.describe()
    assert (described.scans, described.last_stamp) == (6, pytest.approx(parts[-PARTS // 2].stamp, abs=1e-6))
    assert [note for note in described.notes if JOINED in note]
    assert [warning for warning in recording.warnings if JOINED in warning]


def test_lost_parts_leave_the_other_sweeps_as_they_are(tmp_path, turns, parts):
    recording = opened(tmp_path / "parts", [part for n, part in enumerate(parts) if n not in (6, *range(15, 20))])
    sweeps = list(recording.scans())
    assert [len(sweep) for sweep in sweeps] == [len(turns[0]) * share // PARTS for share in (5, 4, 5, 5, 5)]
    assert_same(sweeps[-1], turns[-1])
    assert_same(next(recording.scans(2)), turns[2])
    assert not list(recording.scans(3, 4))


def test_scans_in_other_directions_each_time_are_joined_to_a_tenth_of_a_second(tmp_path, rng):
    recording = opened(tmp_path / "scattered", sparse(rng, 25))
    assert [len(sweep) for sweep in recording.scans()] == [4000] * 5


@pytest.mark.parametrize(("settings", "lengths"), [
    ({}, [800] * 25),
    ({"sweep_s": 0.08}, [3200] * 6 + [800]),
    ({"sweep_s": 0.0}, [800] * 25),
])  # fmt: skip
def test_whole_sweeps_are_joined_where_a_duration_is_set(tmp_path, rng, settings, lengths):
    recording = opened(tmp_path / "dense", sparse(rng, 25, 1.0), **settings)
    assert [len(sweep) for sweep in recording.scans()] == lengths
    assert not [warning for warning in recording.warnings if "joined" in warning]


def test_turns_ten_times_a_second_are_sweeps(tmp_path, turns):
    recording = opened(tmp_path / "turns", turns)
    for sweep, turn in zip(recording.scans(), turns, strict=True):
        assert_same(sweep, turn)


def test_a_factor_on_the_times_applies_within_each_part(tmp_path, parts):
    plain, halved = (
        list(opened(tmp_path / name, parts, time_scale=scale).scans()) for name, scale in (("1", 1.0), ("2", 0.5))
    )
    for sweep, other in zip(plain, halved, strict=True):
        within = np.concatenate([part.time_offsets for part in parts[:PARTS]])
        np.testing.assert_allclose(sweep.time_offsets - other.time_offsets, 0.5 * within, atol=1e-6)


def test_a_run_over_the_parts_is_as_accurate_as_one_over_the_turns(tmp_path, room, drive, room_truth):
    turns = [room.sweep(drive, float(stamp)) for stamp in room_truth.stamps]
    source = write_recording(tmp_path / "parts", [p for turn in turns for p in parts_of(turn)], room_truth, True)
    succeeds("run", source, "-o", tmp_path / "run", "--odometry", "constant-velocity", "--no-report")
    succeeds("evaluate", tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["trajectory"]["ate_rmse_m"] < 0.005
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["scans"] == len(turns)
