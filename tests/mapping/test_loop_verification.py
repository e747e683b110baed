"""Closures of known rooms and corridors: laid on one another, registered finely, and in agreement or not."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform, transform_points
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops import verification
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, LoopClosure, RelativePose, Track
from lidarslam.mapping.loops.sparse_submap import SparseSubmap
from lidarslam.mapping.loops.verification import DenseSubmap, SubmapCloud, evaluate, verify

from .runs import assert_near, errors
from .shapes import on_boxes

MIN_OVERLAP = LoopConfig().min_overlap
# Centre and half sizes; the sensor stands inside.
ROOM = [((0, 0, 1.5), (5, 4, 1.5)), ((3.2, 2.1, 0.6), (0.5, 1.1, 0.6)), ((-4.4, -1.5, 0.9), (0.6, 0.4, 0.9))]
OTHER = [ROOM[0], ((-1.2, 2.4, 0.9), (0.8, 0.5, 0.9)), ((2.6, -1.5, 1.4), (0.6, 2.4, 1.4)), ((-3.6, 0, 1), (0.9, 2, 1))]
CORRIDOR = [((0, 0, 1.3), (60, 1.2, 1.3))]


def submap_from(boxes, T_world_lidar: FloatArray, seed: int, spacing_m=0.08, reach_m=25.0) -> SparseSubmap:
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
    found = verify(room[0], place(OTHER, SECOND, 3), TRUE)
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
    assert [evaluate(stands, one, np.eye(4)).inliers for one in (stands, turned)] == [len(stands.points)] * 2


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


def test_along_a_corridor_what_would_tell_must_fit():
    first, second = pose(0.0, -0.3, 0.0), pose(0.3, -0.3, 0.0)

    def stand(first_x: float, T: FloatArray, seed: int) -> SubmapCloud:
        """In a corridor with closets that reach into it, every four metres but one."""
        closets = [((x, 0.9, 1.3), (0.4, 0.3, 1.3)) for x in first_x + np.array([-12, -8, -4, 0, 4, 12])]
        return SubmapCloud.join(submap_from([*CORRIDOR, *closets], T, seed, 0.06, 9.0))

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
    joined = SubmapCloud.join(room[0].submap, around, [3, 3])
    doubted, source = (replace(one, drift_rates=(0.02, 0.05)) for one in (joined, room[1]))
    found = [verify(*pair, TRUE).T_target_source for pair in ((trusted, room[1]), (doubted, source))]
    off, _ = errors(np.array(found), TRUE)
    assert off[0] > 0.03
    assert off[1] < 0.5 * off[0]


def test_covariance_holds_what_drift_does_within_a_place(room):
    def covariance(target_middle: float, source_middle: float, ahead: float) -> FloatArray:
        first, second = (replace(one, drift_rates=(0.01, 0.02)) for one in room)
        target = replace(first, middle_m=target_middle)
        source = replace(second, middle_m=source_middle, ahead_m=np.full(len(second.points), ahead))
        return evaluate(target, source, TRUE).covariance

    more = covariance(1.0, 2.0, 0.0) - covariance(0.0, 0.0, 0.0)
    assert more == pytest.approx(np.diag([1e-4 * 5 / 3] * 3 + [4e-4 * 5 / 3] * 3), abs=1e-12)
    # What lies behind makes up for a submap that is drawn ahead; points are trusted as much either way.
    more = covariance(0.0, 1.0, 1.0) - covariance(0.0, 1.0, -1.0)
    assert more == pytest.approx(np.diag([1e-4 * 4 / 3] * 3 + [4e-4 * 4 / 3] * 3), abs=1e-12)


RATES = LoopConfig().drift_rates
SIGMAS = np.array([0.003] * 3 + [0.03] * 3)


def agree(a: RelativePose, b: RelativePose, track: Track) -> bool:
    """Whether the cycle of two links closes; links of other pairs of segments make none."""
    cycle = track.close_cycle(a, b)
    return cycle is not None and cycle[0] < CHI_SQUARED_99


@pytest.fixture
def round_trip() -> Track:
    """Forty keyframes on a circle of 20 m, twice round, and one of another segment at the end."""
    angles = np.linspace(0.0, 4.0 * np.pi, 80)
    R = exp(np.stack([0 * angles, 0 * angles, angles, 0 * angles, 0 * angles, 0 * angles], axis=1))[:, :3, :3]
    poses = make_transform(R, np.stack([20.0 * np.cos(angles), 20.0 * np.sin(angles), 0 * angles], axis=1))
    return Track(poses, 20.0 * angles, np.zeros(80, dtype=np.int64), RATES)


def link(track: Track, first: int, second: int, off=(0, 0, 0, 0, 0, 0)) -> RelativePose:
    return RelativePose(first, second, track.between(first, second) @ exp(off), np.diag(SIGMAS**2))


def test_true_links_agree_and_a_false_one_does_not_though_longer_ways_excuse_more(round_trip):
    a, b = link(round_trip, 3, 43), link(round_trip, 8, 48)
    false = link(round_trip, 6, 46, (0, 0, 0, 1.5, 0, 0))
    turned = link(round_trip, 6, 46, (0, 0, np.deg2rad(8.0), 0, 0, 0))
    assert agree(a, b, round_trip)
    assert agree(b, a, round_trip)
    assert not agree(a, false, round_trip)
    assert not agree(false, b, round_trip)
    assert not agree(a, turned, round_trip)
    near, far = link(round_trip, 4, 44), link(round_trip, 30, 70)
    off = link(round_trip, 3, 43, (0, 0, 0, 0.6, 0, 0))
    assert not agree(off, near, round_trip)
    assert agree(off, far, round_trip)


def test_the_uncertainty_of_a_link_turns_with_it(round_trip):
    """A link unsure along its own x, which differs by a quarter turn from the other's, excuses an error along it."""
    quarter = 40 // 4
    loose = np.diag(np.array([0.003] * 3 + [2.0, 0.03, 0.03]) ** 2)
    a = RelativePose(3, 43, round_trip.between(3, 43) @ exp([0, 0, 0, 1.5, 0, 0]), loose)
    across = RelativePose(3, 43, round_trip.between(3, 43) @ exp([0, 0, 0, 0, 1.5, 0]), loose)
    other = link(round_trip, 3 + quarter, 43 + quarter)
    near = link(round_trip, 4, 44)
    assert agree(a, near, round_trip)
    assert agree(near, a, round_trip)
    assert not agree(across, near, round_trip)
    assert agree(a, other, round_trip)


def test_between_segments_only_ways_within_them_count(round_trip):
    """The second is in a world of its own."""
    segment, poses = np.arange(80) // 40, round_trip.T_world_lidar.copy()
    poses[40:] = exp([0.0, 0.0, 2.0, 50.0, -9.0, 3.0]) @ poses[40:]
    two = Track(poses, round_trip.way_m, segment, RATES)
    assert agree(link(round_trip, 3, 43), link(round_trip, 8, 48), two)
    assert not agree(link(round_trip, 3, 43), link(round_trip, 8, 48, (0, 0, 0, 0, 2.5, 0)), two)
    assert not agree(link(two, 3, 23), link(two, 6, 46), two)


def test_correction_is_counted_in_drift(round_trip):
    way = round_trip.way_m[43] - round_trip.way_m[3]
    assert round_trip.correction_sigmas(link(round_trip, 3, 43)) == pytest.approx(0.0, abs=1e-6)
    one = link(round_trip, 3, 43, (0, 0, np.deg2rad(2.0) * way / 100.0, 0, 0, 0))
    assert round_trip.correction_sigmas(one) == pytest.approx(1.0, rel=0.1)
    assert round_trip.correction_sigmas(link(round_trip, 3, 43, (0, 0, 0, 12.0, 0, 0))) > 3.0


def test_drift_grows_with_the_way_and_the_swing(round_trip):
    rotation, translation = round_trip.drift(np.array([42, 33, 3]), 43)
    assert (np.diff(rotation) > 0.0).all()
    assert (np.diff(translation) > 0.0).all()
    way = round_trip.way_m[43] - round_trip.way_m[3]
    assert rotation[2] == pytest.approx(np.deg2rad(0.1 + 0.02 * way), rel=1e-6)
    # The way round a circle lies, root mean square, sqrt(2) radii from a point of it.
    swing = 0.5 * rotation[2] * np.sqrt(2.0) * 20.0
    assert translation[2] == pytest.approx(np.hypot(0.02 + 0.01 * way, swing), rel=0.05)


T_TARGET_SOURCE = exp([0.01, -0.02, 0.6, 3.0, -1.5, 0.1])
OFF = exp([0.004, -0.003, 0.006, 0.05, -0.04, 0.03])
PRIOR = np.diag(np.array([np.deg2rad(0.5)] * 3 + [0.05] * 3) ** 2)
DRIFT = np.diag(np.array([np.deg2rad(0.05)] * 3 + [0.005] * 3) ** 2)
CELL_M = 0.2
PILLARS = ((-6.0, 2.0), (-1.0, -3.0), (5.0, 1.0))
NOISE_M = 0.01


def refine(
    target: DenseSubmap, source: DenseSubmap, T: FloatArray, covariance: FloatArray, drift: FloatArray
) -> LoopClosure | None:
    closure = LoopClosure(0, 1, T, covariance, 0.9, 0.01, 0.9, False, 0, "")
    return verification.refine(target, source, closure, drift)


def planes(rng: np.random.Generator, ends: bool) -> FloatArray:
    """Points on floor, ceiling and walls of a hall of 20 x 8 x 3 m, and on its ends and some pillars."""
    hall, pillars = ((0.0, 0.0, 1.5), (10.0, 4.0, 1.5)), [((x, y, 1.5), (0.4, 0.4, 1.5)) for x, y in PILLARS]
    cloud = on_boxes([hall, *pillars] if ends else [hall], 1.0 / 60.0, rng)
    if not ends:
        cloud = cloud[np.abs(cloud[:, 0]) < 10.0]
    return np.asarray(cloud + rng.normal(scale=NOISE_M, size=cloud.shape))


def submaps(ends: bool = True, seed: int = 3) -> tuple[DenseSubmap, DenseSubmap]:
    """Two of the same hall, each with points of its own, the target at the hall's middle."""
    rng = np.random.default_rng(seed)
    target = DenseSubmap.join([(np.eye(4), planes(rng, ends))], 60.0, CELL_M)
    source = transform_points(inverse(T_TARGET_SOURCE), planes(rng, ends))
    return target, DenseSubmap.join([(np.eye(4), source)], 60.0, CELL_M)


@pytest.mark.parametrize("seed", [0, 3])
def test_a_pose_that_is_centimetres_off_comes_to_within_millimetres_and_its_covariance(seed):
    refined = refine(*submaps(seed=seed), T_TARGET_SOURCE @ OFF, PRIOR, DRIFT)
    assert_near(refined.T_first_second, T_TARGET_SOURCE, 0.003, 0.03)
    xi = log(inverse(refined.T_first_second) @ T_TARGET_SOURCE)
    assert xi @ np.linalg.solve(refined.covariance, xi) < 16.8
    assert (np.diag(refined.covariance) < 0.1 * np.diag(PRIOR)).all()


def test_neither_side_is_preferred_and_what_contradicts_the_verified_pose_is_refused():
    target, source = submaps()
    there = refine(target, source, T_TARGET_SOURCE @ OFF, PRIOR, DRIFT)
    back = refine(source, target, inverse(T_TARGET_SOURCE @ OFF), PRIOR, DRIFT)
    np.testing.assert_allclose(there.T_first_second @ back.T_first_second, np.eye(4), atol=1e-3)
    assert refine(target, source, T_TARGET_SOURCE @ OFF, 1e-2 * PRIOR, DRIFT) is None


def test_along_a_corridor_little_is_known():
    def sigma_m(ends: bool) -> float:
        refined = refine(*submaps(ends), T_TARGET_SOURCE, PRIOR, DRIFT)
        along = T_TARGET_SOURCE[0, :3]  # the hall's axis in the source's frame
        return float(np.sqrt(along @ (refined.covariance - DRIFT)[3:, 3:] @ along))

    assert sigma_m(ends=False) > max(3.0 * sigma_m(ends=True), 0.2 * np.sqrt(PRIOR[3, 3]))


@pytest.mark.parametrize("count", [0, 40])
def test_next_to_nothing_is_not_registered(count):
    target, _ = submaps()
    few = DenseSubmap.join([(np.eye(4), np.random.default_rng(0).uniform(size=(count, 3)))], 60.0, CELL_M)
    far = exp([0.0, 0.0, 0.0, 0.0, 0.0, 500.0])
    assert refine(few, few, far, PRIOR, DRIFT) is None
    assert refine(target, few, far, PRIOR, DRIFT) is None


def test_neighbours_are_joined_where_they_lie():
    points = planes(np.random.default_rng(1), ends=True)
    left, right = points[points[:, 0] < 0.0], points[points[:, 0] >= 0.0]
    T = exp([0.1, 0.2, -0.3, 4.0, 5.0, 0.6])
    joined = DenseSubmap.join([(np.eye(4), left), (T, transform_points(inverse(T), right))], 60.0, CELL_M)
    whole = DenseSubmap.join([(np.eye(4), np.concatenate([left, right]))], 60.0, CELL_M)
    np.testing.assert_allclose(joined.points, whole.points, atol=1e-9)
    assert np.linalg.norm(DenseSubmap.join([(np.eye(4), points)], 5.0, CELL_M).points, axis=1).max() <= 5.0
