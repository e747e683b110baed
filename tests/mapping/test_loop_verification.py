"""Rooms of boxes, sampled as points, laid on themselves from wrong guesses; corridors and other rooms."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform, transform_points
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops.sparse_submap import SparseSubmap
from lidarslam.mapping.loops.verification import SubmapCloud, evaluate, verify

from .runs import assert_near, errors
from .shapes import on_boxes

MIN_OVERLAP = LoopConfig().min_overlap
# Centre and half sizes; the sensor stands inside.
ROOM = [((0, 0, 1.5), (5, 4, 1.5)), ((3.2, 2.1, 0.6), (0.5, 1.1, 0.6)), ((-4.4, -1.5, 0.9), (0.6, 0.4, 0.9))]
OTHER_ROOM = [
    ROOM[0],
    ((-1.2, 2.4, 0.9), (0.8, 0.5, 0.9)),
    ((2.6, -1.5, 1.4), (0.6, 2.4, 1.4)),
    ((-3.6, 0, 1), (0.9, 2, 1)),
]
CORRIDOR = [((0, 0, 1.3), (60, 1.2, 1.3))]


def submap_from(
    boxes, T_world_lidar: FloatArray, seed: int, spacing_m: float = 0.08, reach_m: float = 25.0
) -> SparseSubmap:
    points = on_boxes(boxes, spacing_m**2, np.random.default_rng(seed), 0.005)
    points = transform_points(inverse(T_world_lidar), points)
    points = points[np.linalg.norm(points, axis=1) < reach_m]
    return SparseSubmap.of(points, 60.0)


def pose(x: float, y: float, yaw_deg: float, z: float = 1.3) -> FloatArray:
    return make_transform(exp([0, 0, np.deg2rad(yaw_deg), 0, 0, 0])[:3, :3], [x, y, z])


def place(boxes, T: FloatArray, seed: int) -> SubmapCloud:
    return SubmapCloud.join(submap_from(boxes, T, seed))


FIRST, SECOND = pose(0.5, -0.3, 10.0), pose(-0.4, 0.5, 160.0)
TRUE = inverse(FIRST) @ SECOND


@pytest.fixture(scope="module")
def room() -> tuple[SubmapCloud, SubmapCloud]:
    return place(ROOM, FIRST, 1), place(ROOM, SECOND, 2)


@pytest.mark.parametrize("guess", [(0, 0, 20, 1.0, 0, 0), (0, 0, -20, 0, -1.0, 0), (3, -3, 15, -0.6, 0.6, 0.3)])
def test_exact_from_a_guess_wrong_by_a_metre_and_twenty_degrees(room, guess):
    off = np.array(guess, dtype=float)
    off[:3] = np.deg2rad(off[:3])
    found = verify(*room, TRUE @ exp(off))
    assert_near(found.T_target_source, TRUE, 0.01, 0.1)
    assert found.objection(MIN_OVERLAP) == ""
    assert found.overlap > 0.9
    assert found.information > 0.9
    assert found.degenerate == ()
    assert found.residual_m < 0.02


def test_covariance_has_floors_and_holds_the_error(room):
    found = verify(*room, TRUE)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert (sigmas[:3] > np.deg2rad(0.1)).all()
    assert (sigmas[3:] > 0.01).all()
    assert (sigmas[3:] < 0.05).all()
    xi = log(inverse(found.T_target_source) @ TRUE)
    assert xi @ np.linalg.solve(found.covariance, xi) < 16.8


def test_another_room_of_the_same_size_is_refused(room):
    found = verify(room[0], place(OTHER_ROOM, SECOND, 3), TRUE)
    assert found.objection(MIN_OVERLAP)
    right = verify(*room, TRUE)
    assert found.overlap < right.overlap - 0.1


def test_only_what_a_side_could_see_counts_against_it(room):
    behind = [*ROOM, ((0, 9.0, 1.5), (5, 1.0, 1.5))]  # beyond a wall of the room
    found = evaluate(room[0], place(behind, SECOND, 2), TRUE)
    assert found.overlap > 0.9
    assert found.inlier_ratio < 0.8
    # Whichever of the two sees what the other should have seen.
    before = [*ROOM, ((0.0, 2.5, 1.3), (0.8, 0.3, 1.3)), ((1.5, -2.5, 1.3), (0.3, 0.8, 1.3))]
    assert evaluate(room[0], place(before, SECOND, 2), TRUE).overlap < 0.95 * found.overlap
    assert evaluate(place(before, FIRST, 1), room[1], TRUE).overlap < 0.95 * found.overlap


def test_a_pole_has_no_direction():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-6, 6, (6000, 2)), np.full(6000, -1.5)])
    poles = [np.column_stack([np.tile(xy, (400, 1)), rng.uniform(-1.2, 3.0, 400)]) for xy in rng.uniform(-5, 5, (9, 2))]
    stands = SubmapCloud.join(SparseSubmap.of(np.concatenate([floor, *poles]), 60.0))
    assert stands.is_line.sum() > 50
    turned = replace(stands, axes=np.where(stands.is_line[:, None], -stands.axes, stands.axes))
    assert (
        evaluate(stands, turned, np.eye(4)).inliers == evaluate(stands, stands, np.eye(4)).inliers == len(stands.points)
    )


def test_a_corridor_says_nothing_along_itself():
    first, second = pose(0.0, 0.2, 0.0), pose(3.0, -0.2, 30.0)
    found = verify(place(CORRIDOR, first, 1), place(CORRIDOR, second, 2), inverse(first) @ second)
    # In the second's frame the corridor runs at -30 degrees.
    along = np.array([np.cos(np.deg2rad(30.0)), -np.sin(np.deg2rad(30.0)), 0.0])
    across = np.array([along[1], -along[0], 0.0])
    of_translation = found.covariance[3:, 3:]
    assert np.sqrt(along @ of_translation @ along) > 1.0
    assert np.sqrt(across @ of_translation @ across) < 0.05
    assert found.degenerate
    assert "degenerate in" in found.objection(MIN_OVERLAP)


def doors(first_x: float):
    """A corridor with closets that reach into it, every four metres but one."""
    closets = [((x, 0.9, 1.3), (0.4, 0.3, 1.3)) for x in first_x + np.array([-12, -8, -4, 0, 4, 12])]
    return [*CORRIDOR, *closets]


def test_along_a_corridor_what_would_tell_must_fit():
    first, second = pose(0.0, -0.3, 0.0), pose(0.3, -0.3, 0.0)

    def stand(closets_from: float, T: FloatArray, seed: int) -> SubmapCloud:
        return SubmapCloud.join(submap_from(doors(closets_from), T, seed, 0.06, 9.0))

    target, source, elsewhere = stand(1.0, first, 1), stand(1.0, second, 2), stand(2.7, second, 2)
    right = verify(target, source, inverse(first) @ second)
    assert right.objection(MIN_OVERLAP) == ""
    # Walls, floor and ceiling fit as well where the closets of one stand between those of the other.
    wrong = evaluate(target, elsewhere, inverse(first) @ second)
    assert wrong.overlap > MIN_OVERLAP
    assert wrong.information < 0.3
    assert "weakest direction" in wrong.objection(MIN_OVERLAP)


def test_neighbours_that_drift_may_have_moved_count_less(room):
    stand = pose(1.5, 0.8, 40.0)
    wrong = exp([0, 0, 0, 0.15, 0.1, 0.0]) @ inverse(FIRST) @ stand
    around = [(wrong, submap_from(ROOM, stand, 5)), (wrong, submap_from(ROOM, stand, 6))]
    trusted = SubmapCloud.join(room[0].submap, around, [0, 0])
    doubted, source = (
        replace(place, drift_rates=(0.02, 0.05))
        for place in (SubmapCloud.join(room[0].submap, around, [3, 3]), room[1])
    )
    found = [verify(*pair, TRUE).T_target_source for pair in ((trusted, room[1]), (doubted, source))]
    off, _ = errors(np.array(found), TRUE)
    assert off[0] > 0.03
    assert off[1] < 0.5 * off[0]


def test_covariance_holds_what_drift_does_within_a_place(room):
    def covariance(target_middle: float, source_middle: float, ahead: float) -> FloatArray:
        rates = (0.01, 0.02)
        target = replace(room[0], middle_m=target_middle, drift_rates=rates)
        source = replace(
            room[1], middle_m=source_middle, drift_rates=rates, ahead_m=np.full(len(room[1].points), ahead)
        )
        return evaluate(target, source, TRUE).covariance

    more = covariance(1.0, 2.0, 0.0) - covariance(0.0, 0.0, 0.0)
    assert more == pytest.approx(np.diag([1e-4 * 5 / 3] * 3 + [4e-4 * 5 / 3] * 3), abs=1e-12)
    # What lies behind makes up for a submap that is drawn ahead; points are trusted as much either way.
    more = covariance(0.0, 1.0, 1.0) - covariance(0.0, 1.0, -1.0)
    assert more == pytest.approx(np.diag([1e-4 * 4 / 3] * 3 + [4e-4 * 4 / 3] * 3), abs=1e-12)
