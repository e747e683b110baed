"""The learned odometry with a network whose candidates are given, on scans whose motions are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform
from lidarslam.core.scan import Scan
from lidarslam.odometry.alignment import alignment as search
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.methods.learned import LearnedOdometry
from lidarslam.odometry.network.candidates import Candidate, Described

from . import motions as known
from .motions import STILL, WRONG, errors

Floats = NDArray[np.float32]

IMAGES = ImageConfig(rows=16, columns=360)
TWIST = (0.05, -0.05, 0.5, 1.0, 0.3, 0.1)  # rad/s, m/s


class Told:
    """Answers with one guess, or with one after the other; the last goes on."""

    def __init__(self, *guesses: FloatArray, sigma: float = 0.1) -> None:
        self.guesses, self.sigma = list(guesses), sigma

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:  # noqa: ARG002
        return Described(points[None], np.zeros((0, 0, 0), dtype=np.complex64), heading)

    def compare(self, _: Described, points: Floats, normals: Floats) -> tuple[tuple[Candidate, ...], Described]:
        guess = self.guesses.pop(0) if len(self.guesses) > 1 else self.guesses[0]
        return (Candidate(guess, np.diag(np.full(6, self.sigma**2)), 0.0),), self.describe(points, normals)


def estimates(scans: list[Scan], network: Told, is_aligned: bool = True) -> list[Motion]:
    odometry = LearnedOdometry(network, IMAGES, is_aligned)
    return [odometry.estimate(scan) for scan in scans]


def moved(twist: tuple[float, ...] = TWIST, wrong: tuple[float, ...] = STILL) -> FloatArray:
    return known.moved(twist, wrong)


def assert_close(motion: Motion, truth: FloatArray, rotation_deg: float = 0.15, translation_m: float = 0.006) -> None:
    assert motion.failure is None
    known.assert_close(motion.T_prev_curr, truth, rotation_deg, translation_m)


def stamped(scan: Scan, at: float) -> Scan:
    """A scan with its stamp at this part of its sweep, which was at its start."""
    return replace(scan, stamp=scan.stamp + 0.1 * at, time_offsets=scan.time_offsets - 0.1 * at)


def assert_failed(motion: Motion, why: str) -> None:
    assert why in motion.failure
    assert (motion.points_used, motion.covariance) == (0, None)
    assert np.array_equal(motion.T_prev_curr, np.eye(4))


def test_motions_are_found_from_wrong_guesses(box_room):
    first, *motions = estimates(box_room.scans(4, TWIST), Told(moved(wrong=WRONG)))
    assert np.array_equal(first.T_prev_curr, np.eye(4))
    assert (first.failure, first.covariance) == (None, None)
    for motion in motions:
        assert_close(motion, moved())
    assert all(motion.points_used > 1000 for motion in (first, *motions))


def test_an_empty_scan_and_one_that_is_not_later_are_failures_and_the_next_motion_goes_past_them(box_room):
    scans = box_room.scans(4, TWIST)
    scans[2] = Scan(np.zeros((0, 3)), scans[2].stamp)
    motions = estimates(scans, Told(moved(), moved() @ moved()))
    assert_failed(motions[2], "empty")
    assert_close(motions[3], moved() @ moved())
    assert_failed(estimates([scans[0], scans[0]], Told(moved()))[1], "not later than the one before")


def test_another_place_is_a_failure_and_the_next_pair_works_again(box_room):
    cell = type(box_room)((-1.2, -1.3, -0.7), (1.4, 1.1, 1.0))
    scans = [*box_room.scans(2, TWIST), *cell.scans(5, TWIST)[2:4], *box_room.scans(6, TWIST)[4:]]
    motions = estimates(scans, Told(moved(wrong=WRONG)))
    assert [motion.failure is None for motion in motions] == [True, True, False, True, False, True]
    for motion in (motions[2], motions[4]):
        assert_failed(motion, "does not fit the last one")
    assert_close(motions[5], moved())


@pytest.mark.parametrize(("speed", "dropped"), [(1.5, 0), (1.0, 1)])
def test_a_bad_guess_gives_way_to_the_last_motion_over_the_time_that_went_by(box_room, monkeypatch, speed, dropped):
    monkeypatch.setattr(search, "STEPS_M", ())
    fast = (0.0, 0.0, speed * math.radians(100.0), speed * 1.5, 0.0, 0.0)
    far_off = exp((0.0, 0.0, 1.5, 2.0, 0.0, 0.0))
    scans = box_room.scans(4 + dropped, fast)
    received = [*scans[:3], scans[3 + dropped]]
    truth = moved(tuple((1 + dropped) * part for part in fast))
    assert_close(estimates(received, Told(moved(fast), moved(fast), far_off))[3], truth, 0.5, 0.04)
    alone = estimates(received[2:], Told(far_off))  # there is no last motion
    assert alone[1].failure is not None or errors(alone[1].T_prev_curr, truth)[0] > 10.0


def test_the_first_motion_follows_on_the_expected_velocity_unless_scans_refute_that(box_room, monkeypatch):
    monkeypatch.setattr(search, "STEPS_M", ())
    scans, told = box_room.scans(3, TWIST), moved()
    for velocity, guess in [(TWIST, exp((0.0, 0.0, 1.5, 2.0, 0.0, 0.0))), (TWIST, told), ((0, 0, 15, 20, 0, 0), told)]:
        odometry = LearnedOdometry(Told(guess, told), IMAGES)
        odometry.expect(np.array(velocity, dtype=np.float64))
        for motion in [odometry.estimate(scan) for scan in scans][1:]:
            assert_close(motion, moved())


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_motions_are_those_between_stamps(box_room, stamp_at):
    """A turn that grows by 2.3 degrees a sweep, so that half a sweep makes more than a degree."""
    scans = [stamped(scan, stamp_at) for scan in box_room.as_scans(box_room.sweeps_along(6, way))]
    motions = estimates(scans, Told(np.eye(4)))
    for number in range(2, 6):
        T = way(0.1 * (np.array([number - 1, number]) - 0.5 + stamp_at))
        between_stamps = inverse(T[0]) @ T[1]
        assert_close(motions[number], between_stamps, 0.05, 0.003)
        middles = way(0.1 * np.array([number - 1.0, number]))
        lag = errors(motions[number].T_prev_curr, inverse(middles[0]) @ middles[1])[0]
        assert lag > 0.9 if stamp_at != 0.5 else lag < 0.05


def way(times: FloatArray) -> FloatArray:
    """Poses on a turn about z that grows evenly, by 4 rad/s^2."""
    return exp(np.multiply.outer(2.0 * times**2, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize(("turned", "along"), [(0.0, 3), (0.5 * math.pi, 4)])
def test_between_two_walls_the_covariance_along_them_is_the_networks(walls, turned, along):
    """For a sensor turned by 90 degrees they go along y."""
    scans = near(walls.scans(2, STILL, exp((0.0, 0.0, turned, 0.0, 0.0, 0.0))))
    unsure, sure = (sigmas(scans, Told(np.eye(4), sigma=sigma)) for sigma in (3.0, 0.01))
    assert unsure[along] == pytest.approx(3.0, rel=0.2)
    assert sure[along] < 0.1
    assert unsure[7 - along] < 0.05  # across


def test_the_covariance_is_of_a_change_from_the_right(walls):
    """Turned by 90 degrees in between: x of the previous frame is -y of the current one."""
    quarter = exp((0.0, 0.0, 0.5 * math.pi, 0.0, 0.0, 0.0))
    first, second = near([*walls.scans(1, STILL), *walls.scans(1, STILL, quarter)])
    found = sigmas([Scan(first.points, 0.0), Scan(second.points, 0.1)], Told(quarter, sigma=3.0))
    assert found[4] == pytest.approx(3.0, rel=0.2)
    assert found[3] < 0.05


ALONG = (0.0, 0.0, 0.0, 4.0, 0.0, 0.0)


def test_where_nothing_is_seen_along_a_direction_the_motion_goes_on_as_before(box_room):
    """Past two cabinets into an even corridor; the network takes the latter for standing still."""
    cabinets = (((-1.5, 1.4, -1.5), (-0.9, 2.0, 1.0)), ((0.9, -2.0, -1.5), (1.8, -1.5, 1.5)))
    corridor = type(box_room)((-np.inf, -2.0, -0.8), (np.inf, 2.0, 1.0), cabinets)
    scans = near(corridor.scans(29, ALONG), 5.0)
    motions = estimates(scans, Told(*[moved(ALONG)] * 14, np.eye(4), sigma=0.05))
    for motion in motions[1:]:
        assert_close(motion, moved(ALONG), translation_m=0.02)
    assert [motion.degenerate for motion in motions[:10]] == [()] * 10
    inside = motions[-8:]
    assert [motion.degenerate for motion in inside] == [("x",)] * 8
    variances = [motion.covariance[3, 3] for motion in inside]
    # A random walk of the speed: 2 m/s^2 for 0.1 s, over 0.1 s.
    np.testing.assert_allclose(np.diff(variances), 0.02**2, rtol=0.1)
    assert max(motion.covariance[4, 4] for motion in inside) < 0.01**2


def test_where_the_scene_repeats_itself_motions_continue(box_room):
    """Past cabinets that stand every three metres; in the end the network takes one for the next."""
    cabinets = tuple(((x - 0.3, 1.2, -1.5), (x + 0.3, 2.0, 1.0)) for x in np.arange(-30.0, 36.0, 3.0))
    row = type(box_room)((-np.inf, -2.0, -0.8), (np.inf, 2.0, 1.0), cabinets)
    fast, slow = (0.0, 0.0, 0.0, 20.0, 0.0, 0.0), (0.0, 0.0, 0.0, -10.0, 0.0, 0.0)
    for motion in estimates(near(row.scans(5, fast)), Told(moved(fast), moved(fast), moved(slow)))[1:]:
        assert_close(motion, moved(fast), translation_m=0.1)


@pytest.fixture(scope="module")
def walls(box_room):
    """Two walls along x, and nothing else."""
    return type(box_room)((-np.inf, -2.0, -np.inf), (np.inf, 2.0, np.inf))


def near(scans: list[Scan], within_m: float = 12.0) -> list[Scan]:
    """What is not far; farther off, the two walls meet in one neighbourhood, which looks like a wall across."""
    return [scan.select(np.linalg.norm(scan.points, axis=1) < within_m) for scan in scans]


def sigmas(scans: list[Scan], network: Told) -> FloatArray:
    """(6,) standard deviations of the last motion, rotation first."""
    motion = estimates(scans, network)[-1]
    assert motion.failure is None
    return np.sqrt(np.diag(motion.covariance))


def test_a_guess_that_is_no_motion_is_a_failure_and_the_next_pair_works_again(box_room):
    nothing = np.full((4, 4), np.nan)
    motions = estimates(box_room.scans(4, TWIST), Told(moved(), nothing, moved()))
    assert_failed(motions[2], "not a motion; try other weights")
    assert_close(motions[3], moved())
    unsure = estimates(box_room.scans(2, TWIST), Told(moved(), sigma=math.inf))
    assert unsure[1].failure is not None


def test_without_alignment_the_motion_is_the_networks(box_room):
    guess = moved(wrong=(0.0, 0.0, 0.0, 0.02, 0.0, 0.0))
    scans = [stamped(scan, 0.5) for scan in box_room.scans(2, TWIST)]
    motions = estimates(scans, Told(guess), is_aligned=False)
    np.testing.assert_allclose(motions[1].T_prev_curr, guess, atol=1e-6)
    assert motions[1].covariance is not None
    assert motions[1].points_used > 1000


@pytest.mark.parametrize("angles_deg", [(90, 0, 0), (0, 90, 0), (-90, 0, 0), (30, 50, 0)])
def test_recorded_axes_do_not_matter(box_room, angles_deg):
    """A sensor spins about one of its axes, which need not be called z."""
    scans = box_room.scans(3, TWIST)
    R = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
    turned = [replace(scan, points=np.ascontiguousarray(scan.points @ R.T)) for scan in scans]
    T = make_transform(R, np.zeros(3))
    for motion, expected in zip(estimates(turned, Told(np.eye(4))), estimates(scans, Told(np.eye(4))), strict=True):
        assert motion.failure is None
        np.testing.assert_allclose(inverse(T) @ motion.T_prev_curr @ T, expected.T_prev_curr, atol=0.01)
        assert motion.degenerate == expected.degenerate == ()


def test_the_motion_after_skipped_scans_is_since_the_last_of_them(box_room):
    scans = box_room.scans(6, TWIST)
    odometry = LearnedOdometry(Told(moved(wrong=WRONG)), IMAGES)
    for scan in scans[:2]:
        odometry.estimate(scan)
    for scan in scans[2:5]:
        odometry.skip(scan)
    motion = odometry.estimate(scans[5])
    begun_there = estimates(scans[4:], Told(moved(wrong=WRONG)))[1]
    assert_close(motion, moved())
    np.testing.assert_array_equal(motion.T_prev_curr, begun_there.T_prev_curr)
    np.testing.assert_array_equal(motion.covariance, begun_there.covariance)
