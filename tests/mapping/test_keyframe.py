"""When the next keyframe is due."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.mapping.config import KeyframeConfig
from lidarslam.mapping.pose_graph import keyframe_graph
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeSelector


@pytest.fixture
def hall(rng: np.random.Generator) -> FloatArray:
    """Points on a circle of walls 8 m away."""
    angle, height = rng.uniform(-np.pi, np.pi, 4000), rng.uniform(-1.0, 2.0, 4000)
    return np.stack([8.0 * np.cos(angle), 8.0 * np.sin(angle), height], axis=1)


def selector(points: FloatArray, **options: float | None) -> KeyframeSelector:
    chosen = KeyframeSelector(KeyframeConfig.model_validate(options))
    assert chosen.is_due(np.eye(4), points)
    chosen.take(np.eye(4), points)
    return chosen


def moved(x: float = 0.0, turn_deg: float = 0.0) -> FloatArray:
    return exp([0.0, 0.0, np.deg2rad(turn_deg), x, 0.0, 0.0])


@pytest.mark.parametrize(("scale", "given_m", "distance_m"), [
    (1.0, None, 2.05), (4.0, None, 4.0), (0.1, None, 0.5), (1.0, 3.0, 3.0),
])  # fmt: skip
def test_the_way_to_the_next_follows_the_scene_or_is_the_given_one(hall, monkeypatch, scale, given_m, distance_m):
    """A quarter of 8 m; in a hall four times as large it would be 4 m at most, in a shaft 0.5 m at least."""
    monkeypatch.setattr(keyframe_graph, "_LEAST_OVERLAP", 0.0)
    chosen = selector(scale * hall, distance_m=given_m)
    assert not chosen.is_due(moved(0.97 * distance_m), scale * hall)
    assert chosen.is_due(moved(1.03 * distance_m), scale * hall)


def test_a_turn_on_the_spot_makes_a_keyframe(hall):
    chosen = selector(hall, turn_deg=30.0)
    assert not chosen.is_due(moved(turn_deg=29.0), hall)
    assert chosen.is_due(moved(turn_deg=-31.0), hall)


@pytest.mark.parametrize(("least_overlap", "is_due"), [(0.6, True), (0.4, False)])
def test_a_scan_that_sees_other_things_is_due(hall, monkeypatch, least_overlap, is_due):
    """Half of it elsewhere: through a door, say."""
    monkeypatch.setattr(keyframe_graph, "_LEAST_OVERLAP", least_overlap)
    beyond = hall + np.where(hall[:, :1] > 0.0, [[10.0, 0.0, 0.0]], 0.0)
    assert not selector(hall).is_due(moved(0.1), hall)
    assert selector(hall).is_due(moved(0.1), beyond) == is_due


def test_noise_is_no_new_sight(hall, rng, monkeypatch):
    monkeypatch.setattr(keyframe_graph, "_LEAST_OVERLAP", 0.95)
    chosen = selector(hall)
    assert not chosen.is_due(np.eye(4), hall + rng.normal(0.0, 0.05, hall.shape))
