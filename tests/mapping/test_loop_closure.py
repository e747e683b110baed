"""A hall gone round twice, with drift; segments without relation; rooms that are all the same; a planted falsehood."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, transform_points
from lidarslam.core.trajectory import chain
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops import detection
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.loops.detection import KeyframeDatabase, LoopDetector

from .runs import assert_near
from .shapes import on_boxes


@dataclass(frozen=True, eq=False)
class Submap:
    """What `LoopDetector.add` takes of a keyframe."""

    index: int
    segment: int
    way_m: float
    points: FloatArray


SEEN_M = 11.0
UPSIDE_DOWN = exp([np.pi, 0, 0, 0, 0, 0])
# The hall is small beside the way round it.
CONFIG = LoopConfig(min_way_m=10.0)


@pytest.fixture(scope="module")
def hall() -> FloatArray:
    """36 x 28 x 4 m with boxes of all sizes along the walls and in the middle."""
    rng = np.random.default_rng(3)
    boxes = [((0, 0, 2), (18, 14, 2))]
    for _ in range(24):
        x, y = rng.uniform((-17, -13), (17, 13))
        if not (6.0 < max(abs(x), abs(y) + 2.0) < 12.5):
            half = rng.uniform(0.3, 1.4, 3)
            boxes.append(((x, y, half[2]), half))
    return on_boxes(boxes, 0.035, rng, 0.005)


def round_trip(laps: float, step_m: float = 2.0) -> FloatArray:
    """Poses (K, 4, 4) round an ellipse, facing along."""
    angles = np.arange(0.0, laps * 2.0 * np.pi, step_m / 8.5)
    xy = np.stack([10.0 * np.cos(angles), 7.0 * np.sin(angles)], axis=1)
    yaw = np.arctan2(7.0 * np.cos(angles), -10.0 * np.sin(angles))
    R = exp(np.multiply.outer(yaw, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))[:, :3, :3]
    return make_transform(R, np.column_stack([xy, np.full(len(xy), 1.5)]))


def submaps_of(points: FloatArray, truth: FloatArray, segment: int = 0, first: int = 0) -> list[Submap]:
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    rng = np.random.default_rng(segment)
    made = []
    for i, T in enumerate(truth):
        seen = transform_points(inverse(T), points[rng.random(len(points)) < 0.5])
        made.append(Submap(first + i, segment, float(way[i]), seen[np.linalg.norm(seen, axis=1) < SEEN_M]))
    return made


def drifted(truth: FloatArray) -> FloatArray:
    """1 degree in 100 m to the left, and lengths 0.5 % too long."""
    motions = inverse(truth[:-1]) @ truth[1:]
    motions[:, :3, 3] *= 1.005
    length = np.linalg.norm(motions[:, :3, 3], axis=1)
    error = np.zeros((len(motions), 6))
    error[:, 2] = np.deg2rad(1.0) / 100.0 * length
    return chain(truth[0], motions @ exp(error))


def add(detector: LoopDetector, submap: Submap, estimates: FloatArray) -> list[LoopClosure]:
    return detector.add(submap.points, submap.way_m, submap.segment, estimates[: submap.index + 1])


def detect(submaps: list[Submap], estimates: FloatArray, config: LoopConfig = CONFIG) -> list[LoopClosure]:
    detector = LoopDetector(config)
    return [c for s in submaps for c in add(detector, s, estimates)] + detector.finish()


def accepted(closures: list[LoopClosure]) -> list[LoopClosure]:
    return [closure for closure in closures if closure.accepted]


def assert_right(closures: list[LoopClosure], truth: FloatArray) -> None:
    """Nearly: neighbours lie where the drifting estimates have them."""
    for closure in closures:
        assert_near(closure.T_first_second, inverse(truth[closure.first]) @ truth[closure.second], 0.04, 0.2)


@pytest.fixture(scope="module")
def twice(hall) -> tuple[list[Submap], FloatArray]:
    truth = round_trip(1.4)
    return submaps_of(hall, truth), truth


def test_a_lap_is_closed_in_spite_of_drift(twice):
    submaps, truth = twice
    found = accepted(detect(submaps, drifted(truth)))
    assert len(found) >= 5
    assert_right(found, truth)
    assert all(c.first < c.second and c.reason == "" for c in found)
    assert any(not c.by_appearance for c in found)
    assert found[-1].consistent > 0
    assert all(submaps[c.second].way_m - submaps[c.first].way_m > 10.0 for c in found)


def test_a_lap_is_closed_by_appearance_alone(twice, monkeypatch):
    submaps, truth = twice
    monkeypatch.setattr(KeyframeDatabase, "_nearby", lambda *_: iter(()))
    found = accepted(detect(submaps, drifted(truth)))
    assert len(found) >= detection._CONSISTENT + 1
    assert_right(found, truth)
    assert all(c.by_appearance and c.consistent >= detection._CONSISTENT for c in found)


def test_closures_keep_their_distance(twice, monkeypatch):
    submaps, truth = twice
    monkeypatch.setattr(detection, "_SPACING_M", 7.0)
    found = accepted(detect(submaps, drifted(truth)))
    ways = np.array([submaps[c.second].way_m for c in found])
    assert len(ways) >= 2
    assert (np.diff(ways) >= 7.0).all()


def test_nothing_is_closed_on_a_way_without_return(hall):
    truth = round_trip(0.45)
    assert accepted(detect(submaps_of(hall, truth), truth)) == []


@pytest.mark.long
def test_segments_are_joined_whatever_their_worlds_and_mounts(hall):
    first, second = round_trip(0.6), round_trip(0.9)[9:] @ exp([0, 0, 0.2, 0.3, -0.2, 0.0]) @ UPSIDE_DOWN
    submaps = submaps_of(hall, first, 0) + submaps_of(hall, second, 1, len(first))
    unrelated = exp([0.1, 0.2, 2.0, 300.0, 5.0, -9.0])
    found = accepted(detect(submaps, np.concatenate([first, unrelated @ second])))
    assert len(found) >= detection._CONSISTENT + 1
    assert_right(found, np.concatenate([first, second]))
    assert all(c.first < len(first) <= c.second for c in found)
    assert all(c.consistent >= detection._CONSISTENT for c in found)


@pytest.mark.parametrize(("min_way_m", "min_similarity"), [(10.0, 0.35), (1.0, -1.0)])
def test_rooms_that_are_all_the_same_are_not_taken_for_one(min_way_m, min_similarity, monkeypatch):
    """One room after the other, each exactly like the last: everything fits, and drift explains none of it."""
    monkeypatch.setattr(detection, "_MIN_SIMILARITY", min_similarity)
    rng = np.random.default_rng(0)
    boxes = [((0, 0, 1.5), (5, 4, 1.5)), ((3, 2, 0.6), (0.6, 1, 0.6)), ((-4, -1, 0.9), (0.7, 0.4, 0.9))]
    room = on_boxes(boxes, 0.035, rng, 0.005)
    stands = make_transform(np.eye(3), np.array([[-2.0, -1.0, 1.3], [0.0, 0.5, 1.3], [2.0, -1.0, 1.3]]))
    truth, submaps = [], []
    for number in range(6):
        for s in range(3):
            T = stands[s].copy()
            seen = transform_points(inverse(T), room[rng.random(len(room)) < 0.7])
            submaps.append(Submap(len(submaps), 0, 12.0 * number + 2.0 * s, seen))
            T[0, 3] += 12.0 * number
            truth.append(T)
    found = accepted(detect(submaps, np.stack(truth), LoopConfig(min_way_m=min_way_m)))
    assert all(c.first // 3 == c.second // 3 for c in found)


def test_a_planted_falsehood_is_refused(twice, monkeypatch):
    submaps, truth = twice
    honest, calls = detection.verify, []

    def lying(target, source, guess):
        found = honest(target, source, guess)
        calls.append(found)
        if found is None or len(calls) not in (6, 7):
            return found
        return replace(found, T_target_source=found.T_target_source @ exp([0, 0, 0, 1.2, 0.0, 0.0]))

    monkeypatch.setattr(detection, "verify", lying)
    closures = detect(submaps, drifted(truth))
    assert len(calls) > 7
    assert len(accepted(closures)) >= 4
    assert_right(accepted(closures), truth)
    assert any(not c.accepted for c in closures)


@pytest.mark.long
def test_what_drift_cannot_explain_is_refused(twice):
    submaps, truth = twice
    config = LoopConfig(min_way_m=10.0, drift_percent=0.01)
    assert accepted(detect(submaps, drifted(drifted(truth)), config)) == []


@pytest.mark.parametrize("count", [0, 1, 50])
def test_empty_and_tiny_submaps_close_nothing(count):
    detector = LoopDetector(LoopConfig())
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (count, 3))
    for i in range(12):
        assert detector.add(points, 10.0 * i, 0, np.tile(np.eye(4), (i + 1, 1, 1))) == []
    assert detector.finish() == []


def test_closures_wait_for_others_to_agree_until_the_segment_ends(twice, monkeypatch):
    submaps, truth = twice
    monkeypatch.setattr(detection, "_ALONE_RANGES", 0.0)
    monkeypatch.setattr(detection, "_CONSISTENT", 99)
    monkeypatch.setattr(KeyframeDatabase, "_alike", lambda *_: [])
    detector, estimates = LoopDetector(CONFIG), drifted(truth)
    last = next(i for i, s in enumerate(submaps) if s.way_m > 60.0)
    waiting = [c for s in submaps[:last] for c in add(detector, s, estimates)]
    assert accepted(waiting) == []
    decided = add(detector, Submap(last, 1, 0.0, np.zeros((0, 3))), estimates)
    assert len(decided) > 2
    assert {c.reason for c in decided} == {"no other closure agrees"}
    assert detector.finish() == []


def test_a_cloud_is_a_keyframe_with_its_neighbours(twice):
    submaps, truth = twice
    kept = KeyframeDatabase(CONFIG)
    for i, submap in enumerate(submaps[:8]):
        kept.add(submap.points, submap.way_m, int(i >= 6), truth[: i + 1])
    way = kept.track.way_m
    for index, around in ((0, [0, 1, 2]), (3, [1, 2, 3, 4, 5]), (5, [3, 4, 5]), (7, [6, 7])):
        cloud = kept.cloud(index)
        assert sorted(set(cloud.ahead_m)) == pytest.approx([way[i] - way[index] for i in around])
        assert cloud.drift_rates == pytest.approx((np.deg2rad(2.0) / 100.0, 0.01))
        assert cloud.submap is kept.submaps[index]
    # The neighbours' points lie on the same walls: the hall's are 14 m from its middle.
    world = transform_points(truth[3], kept.cloud(3).points)
    assert (np.abs(world[:, 1]) < 14.1).all()
