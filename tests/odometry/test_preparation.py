"""Motions of recordings that are known, found without a guess."""

import math

import numpy as np
import pytest
import torch

from lidarslam.core.scan import Scan
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.training.preparation import PreparedRecording, prepare

from .motions import assert_close, moved

CONFIG = ImageConfig(rows=16, columns=360)
SLOW = (0.05, -0.05, 0.1, 1.0, 0.3, 0.1)
TURNING = (0.0, 0.0, math.radians(120.0), 1.0, 0.3, 0.0)


def assert_true(recording: PreparedRecording, twist: tuple[float, ...], translation_m: float = 0.006) -> None:
    """Of all valid motions; the rest is that of normals near edges."""
    assert_close(recording.T_prev_curr[recording.valid].double().numpy(), moved(twist), 0.15, translation_m)


@pytest.mark.parametrize("twist", [SLOW, TURNING])
def test_motions_are_found_from_scratch(box_room, twist):
    recording = prepare(box_room.scans(10, twist), CONFIG)  # more than are made into images at a time
    assert len(recording) == 10
    assert recording.points.shape == (10, 3, 16, 360)
    assert recording.valid.all()
    assert_true(recording, twist)
    torch.testing.assert_close(recording.interval_s, torch.full((9,), 0.1), rtol=0, atol=1e-6)


def test_sudden_turns_are_found_from_rest(box_room):
    """More than alignment finds its way over by itself, with other motions on top."""
    fast = (0.0, 0.0, math.radians(-250.0), 1.0, 0.3, 0.0)
    clouds = [sweep.points.reshape(3, -1).T.astype(np.float64) for sweep in box_room.sweeps(2, fast, rolling=False)]
    recording = prepare([Scan(cloud, 0.1 * i) for i, cloud in enumerate(clouds)], CONFIG)
    assert recording.valid.all()
    assert_true(recording, fast, 0.003)


def test_scans_of_different_places_are_not_valid(box_room, corridor):
    scans = [*box_room.scans(2, SLOW), *corridor.scans(2, SLOW)]
    assert prepare(scans, CONFIG).valid.tolist() == [True, False, True]


@pytest.mark.parametrize("kind", ["noise", "empty"])
def test_one_bad_scan_does_not_lose_those_after_it(box_room, kind):
    scans = box_room.scans(6, TURNING)
    points = np.random.default_rng(0).normal(size=(4000 if kind == "noise" else 0, 3))
    scans[2] = Scan.from_raw(3.0 * points, scans[2].stamp + 0.05)
    recording = prepare(scans, CONFIG)
    assert recording.valid.tolist() == [True, False, False, True, True]
    assert_true(recording, TURNING)


def test_scans_at_one_time_do_not_move_infinitely_fast(box_room):
    scan = box_room.scans(1, SLOW)[0]
    recording = prepare([scan, scan], CONFIG)
    assert recording.interval_s > 0.0
    assert recording.T_prev_curr.isfinite().all()
