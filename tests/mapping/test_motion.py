"""Motion compensation, where a scan is expected and how far that is to be trusted, and the bias of velocities."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep, body_velocity, deskew
from lidarslam.mapping.motion.prediction import (
    LEAST_SIGMA,
    UNKNOWN_VELOCITY,
    MotionState,
    OdometryNoise,
    Prediction,
    Prior,
    ProcessNoise,
    corrected_by_motion,
    predict,
)

VELOCITY = np.array([0.1, -0.2, 0.5, 2.0, 0.3, -0.1])  # rad/s, m/s
MOVED = exp(0.1 * VELOCITY)
# What the odometry says differs from going on by 3 degrees and 20 cm.
OFF = np.array([0.03, -0.03, 0.03, 0.1, -0.1, 0.15])
CONFIG = MappingConfig()
# Of the pose of the last scan and of its velocity.
POSE_SIGMA, VELOCITY_SIGMA = np.array([1e-7] * 3 + [1e-6] * 3), np.array([0.5] * 3 + [1.0] * 3)
WELL_KNOWN = np.diag([1e-4] * 3 + [1e-3] * 3 + [1e-2] * 3 + [0.1] * 3) ** 2


def predicted(prior: Prior, config: MappingConfig | None = None, pose: FloatArray | None = None) -> Prediction:
    known = np.diag(np.concatenate([POSE_SIGMA, VELOCITY_SIGMA]) ** 2)
    state = MotionState(5.0, np.eye(4) if pose is None else pose, VELOCITY, known, seen_until_s=0.1)
    return predict(state, 5.1, prior, ProcessNoise(), config or CONFIG)


def ahead(away_m: float, aside_m: float = 0.0) -> FloatArray:
    return exp([0.0, 0.0, 0.0, away_m, aside_m, 0.0])


def motion_covariance(prediction: Prediction) -> FloatArray:
    """(6, 6) of the pose, without what no pose is better than."""
    return prediction.covariance[:6, :6] - np.diag(LEAST_SIGMA**2)


def step(prediction: Prediction) -> FloatArray:
    """(6,) from where the sensor would be if it went on, to where it is expected."""
    return log(inverse(MOVED) @ prediction.T_world_lidar)


def measured(*args: Any, **kwargs: Any) -> Prior:
    """Of an odometry whose covariance is taken as it is."""
    return Prior(*args, **kwargs, caution=1.0)


def isotropic(sigma: float) -> FloatArray:
    return sigma**2 * np.eye(6)


def test_without_an_odometry_the_sensor_goes_on():
    prediction = predicted(measured())
    np.testing.assert_allclose(prediction.T_world_lidar, MOVED, atol=1e-12)
    np.testing.assert_allclose(prediction.velocity, VELOCITY)


def test_an_odometry_that_is_sure_is_believed_and_one_that_is_unsure_is_not():
    alone, unsure = predicted(measured()), predicted(measured(MOVED @ exp(OFF), covariance=isotropic(1e3)))
    np.testing.assert_allclose(step(unsure), 0.0, atol=1e-6)
    np.testing.assert_allclose(unsure.covariance, alone.covariance, rtol=1e-4, atol=1e-9)
    prediction = predicted(measured(MOVED @ exp(OFF), covariance=isotropic(1e-5)))
    np.testing.assert_allclose(step(prediction), OFF, atol=1e-4)
    assert np.sqrt(np.diag(motion_covariance(prediction))).max() < 1.1e-5


def test_each_direction_is_believed_as_its_own_covariance_says():
    """In the frame of the sensor as it is now, wherever it is in the world."""
    covariance = isotropic(1e-4)
    covariance[3, 3] = 1e6
    for pose in (np.eye(4), exp([0.4, -0.3, 1.5, 10.0, -5.0, 2.0])):
        prediction = predicted(measured(MOVED @ exp(OFF), covariance=covariance), pose=pose)
        moved = log(inverse(pose @ MOVED) @ prediction.T_world_lidar)
        np.testing.assert_allclose(np.delete(moved, 3), np.delete(OFF, 3), atol=2e-3)
        sigmas = np.sqrt(np.diag(motion_covariance(prediction)))
        assert sigmas[3] > 0.005
        assert np.delete(sigmas, 3).max() < 2e-4


def test_an_odometry_is_believed_less_than_it_says_by_the_caution_or_as_configured_where_it_does_not_say():
    config = MappingConfig(prior_rotation_deg=2.0, prior_translation_m=0.3)
    sigmas = np.array([np.deg2rad(2.0)] * 3 + [0.3] * 3)
    moved = MOVED @ exp(OFF), VELOCITY + 1.0
    cautious, silent = predicted(Prior(*moved, isotropic(0.01), caution=5.0)), predicted(measured(*moved), config)
    for found, told in ((cautious, isotropic(0.05)), (silent, np.diag(sigmas**2))):
        for name, value in vars(predicted(measured(*moved, told))).items():
            np.testing.assert_allclose(getattr(found, name), value, atol=1e-12)
    other = predicted(measured(*moved), MappingConfig(prior_translation_m=0.01))
    assert not np.allclose(silent.T_world_lidar, other.T_world_lidar, atol=1e-4)


def test_a_velocity_counts_with_twice_the_deviation_of_the_motion_it_is_derived_from():
    sigma, before = 1e-4, np.linalg.inv(predicted(measured()).covariance)
    prediction = predicted(measured(velocity=VELOCITY, covariance=isotropic(sigma)))
    # The least deviation of a pose is added after the measurement: compared without it, where it is next to nothing.
    gained = np.linalg.inv(prediction.covariance)[6:, 6:] - before[6:, 6:]
    np.testing.assert_allclose(np.diag(gained), (2.0 * sigma / 0.1) ** -2, rtol=1e-2)


def test_uncertainty_goes_along_with_the_sensor():
    """Half a metre along x of the last scan is along y of one that has turned by 90 degrees meanwhile."""
    turning = np.array([0.0, 0.0, 0.5 * np.pi / 0.1, 0.0, 0.0, 0.0])
    last = MotionState(5.0, np.eye(4), turning, np.diag([1e-4] * 3 + [0.5] + [1e-4] * 8) ** 2, 0.1)
    prediction = predict(last, 5.1, measured(), ProcessNoise(), CONFIG)
    sigmas = np.sqrt(np.diag(prediction.covariance)[:6])
    assert sigmas[4] == pytest.approx(0.5, rel=0.01)
    assert sigmas[3] < 0.1


@pytest.mark.parametrize("seen_from_s", [0.0, 0.05, 0.1], ids=["stamped at the start", "in the middle", "at the end"])
def test_pose_and_velocity_have_the_joint_covariance_of_sweeps_that_follow_one_another(seen_from_s):
    """Monte Carlo: each sweep at its own velocity, the second beginning where the first ended."""
    rng, count, sigma = np.random.default_rng(1), 200_000, 15.0 * 0.1
    before = rng.normal(scale=VELOCITY_SIGMA[3], size=count)
    after = before + rng.normal(scale=sigma, size=count)
    way = before * (0.1 - seen_from_s) + after * seen_from_s
    known = np.diag(np.concatenate([np.full(6, 1e-9), np.full(6, VELOCITY_SIGMA[3])]) ** 2)
    state = MotionState(5.0, np.eye(4), np.zeros(6), known, seen_until_s=0.1 - seen_from_s)
    covariance = predict(state, 5.1, measured(), ProcessNoise(translation=15.0), CONFIG, seen_from_s).covariance
    joint = covariance[np.ix_([4, 10], [4, 10])]
    uneven = (15.0 * 0.1**2 / 8.0) ** 2 + LEAST_SIGMA[4] ** 2
    np.testing.assert_allclose(joint - np.diag([uneven, 0.0]), np.cov(way, after), rtol=0.02, atol=2e-4)


def test_a_velocity_that_disagrees_with_the_way_between_poses_is_improbable():
    """Independent, both would be likely; it is the correlation that keeps the one from making up for the other."""
    state = MotionState(5.0, np.eye(4), np.zeros(6), WELL_KNOWN, seen_until_s=0.05)
    covariance = predict(state, 5.1, measured(), ProcessNoise(), CONFIG, 0.05).covariance
    back_and_fast = np.zeros(12)
    back_and_fast[3], back_and_fast[9] = -0.05, 1.0
    forth_and_fast = np.abs(back_and_fast)
    assert back_and_fast @ np.linalg.solve(covariance, back_and_fast) > 20.0
    assert forth_and_fast @ np.linalg.solve(covariance, forth_and_fast) < 1.0


def test_the_motion_between_two_scans_says_nothing_of_where_the_first_was():
    """However sure the odometry is, the next pose is no better known than the last."""
    known = np.diag(np.array([1e-6] * 3 + [0.3] * 3 + [1e-6] * 6) ** 2)
    state = MotionState(5.0, np.eye(4), np.zeros(6), known)
    prediction = predict(state, 5.1, measured(np.eye(4), covariance=isotropic(1e-6)), ProcessNoise(), CONFIG)
    np.testing.assert_allclose(np.sqrt(np.diag(prediction.covariance))[3:6], 0.3, rtol=1e-3)


def test_an_odometry_that_the_motion_before_makes_improbable_is_contradicted():
    assert not predicted(measured(MOVED, covariance=isotropic(0.01))).contradicted
    assert not predicted(measured()).contradicted
    driving = MotionState(5.0, np.eye(4), np.array([0.0, 0.0, 0.0, 11.0, 0.0, 0.0]), WELL_KNOWN, 0.1)
    standing = measured(np.eye(4), covariance=isotropic(0.01))
    assert predict(driving, 5.1, standing, ProcessNoise(), CONFIG).contradicted
    doubted = OdometryNoise(variance=1e4)
    assert not predict(driving, 5.1, standing, ProcessNoise(), CONFIG, odometry_noise=doubted).contradicted


def test_the_noise_of_an_odometry_follows_its_errors():
    rng, noise, told = np.random.default_rng(0), OdometryNoise(), measured(MOVED, covariance=isotropic(0.01))
    for sigma, (least, most) in ((0.01, (0.0, 2.5)), (0.1, (50.0, 200.0))):
        for _ in range(200):
            noise = noise.updated(told, MOVED @ exp(rng.normal(scale=sigma, size=6)), CONFIG)
        assert least < noise.variance < most
        assert noise.covariance(told, CONFIG)[0, 0] == pytest.approx(noise.variance * isotropic(0.01)[0, 0])
    assert noise.updated(measured(), MOVED, CONFIG) is noise


def test_an_odometry_whose_errors_have_one_sign_counts_less():
    """Two standard deviations, well within ten."""
    noise, told = OdometryNoise(), Prior(MOVED, covariance=isotropic(0.01))
    for _ in range(50):
        noise = noise.updated(told, MOVED @ ahead(0.02), CONFIG)
    assert noise.variance == 1.0
    np.testing.assert_allclose(noise.covariance(told, CONFIG), 6.0 * told.motion_covariance(CONFIG), rtol=1e-3)


def test_an_odometry_confirms_and_rejects_motions_once_it_was_consistent_for_long():
    prior, near, far = Prior(MOVED, covariance=isotropic(0.01), caution=2.0), MOVED, MOVED @ exp([0.0] * 5 + [0.8])
    noise = OdometryNoise()
    assert noise.agrees(prior, near, CONFIG) is None
    for _ in range(10):
        noise = noise.updated(prior, near, CONFIG)
    assert noise.agrees(prior, near, CONFIG) is True
    assert noise.agrees(prior, far, CONFIG) is False
    assert noise.agrees(measured(), near, CONFIG) is None


def test_what_is_held_keeps_its_prediction_and_what_is_correlated_with_it_does_not_change():
    last = MotionState(0.0, exp([0.0, 0.0, 0.4, 1.0, 2.0, 0.0]), np.zeros(6), UNKNOWN_VELOCITY)
    prediction = predict(last, 0.1, measured(), ProcessNoise(), CONFIG)
    held = prediction.held_along(np.array([0.0, 0.0, 1.0]))
    sigmas, before = (np.sqrt(np.diag(part.covariance)) for part in (held, prediction))
    assert sigmas[[5, 11]].max() < 0.002
    np.testing.assert_allclose(np.delete(sigmas, [5, 11]), np.delete(before, [5, 11]), rtol=1e-6)
    assert np.linalg.eigvalsh(held.covariance).min() > 0.0


def test_an_odometry_that_measures_a_clearly_different_motion_conflicts():
    covariance = np.diag(np.array([0.001] * 3 + [0.01] * 3) ** 2)
    prior = Prior(ahead(0.1, 0.02), covariance=covariance)
    still, along, fast = (ahead(x, 0.02) for x in (0.0, 0.13, 1.0))
    assert OdometryNoise().conflict(prior, still, 0.1) == "x"
    assert OdometryNoise().conflict(prior, along, 0.1) is None, "within four standard deviations"
    assert OdometryNoise().conflict(prior, still, 0.03) is None, "faster than people walk"
    assert OdometryNoise(variance=10.0).conflict(prior, still, 0.1) is None, "known to be that wrong"
    assert OdometryNoise().conflict(replace(prior, T_prev_curr=fast), ahead(1.2, 0.02), 0.2) is None, "a fifth"
    assert OdometryNoise().conflict(replace(prior, covariance=None), still, 0.1) is None
    assert OdometryNoise().conflict(Prior(), still, 0.1) is None


def test_a_smoothed_motion_is_held_and_another_one_is_not():
    smoothed = predicted(Prior(MOVED, covariance=np.diag([1e-6] * 3 + [2.5e-5] * 3), is_smoothed=True))
    near = smoothed.T_world_lidar @ ahead(0.02)
    assert smoothed.holds(near, 0.0)
    assert not smoothed.holds(smoothed.T_world_lidar @ ahead(0.5), 0.0)
    assert not predicted(Prior(MOVED)).holds(near, 1.0)


def test_a_motion_is_allowed_within_a_few_of_the_odometrys_deviations():
    covariance = np.diag([1e-6] * 3 + [0.01**2] * 3)
    far = MOVED @ ahead(0.06)
    assert Prior(MOVED, covariance=covariance).allows(MOVED @ ahead(0.05))
    assert not Prior(MOVED, covariance=covariance).allows(far)
    assert Prior(MOVED).allows(far)
    assert Prior().allows(far)


def test_the_likelihood_of_a_motion_falls_with_its_distance_from_a_proven_odometrys():
    prior = Prior(MOVED, covariance=np.diag([1e-6] * 3 + [0.01**2] * 3), caution=2.0)
    noise = OdometryNoise(variance=4.0, agreed=20)
    assert noise.likelihood(prior, MOVED @ ahead(0.04), CONFIG) == pytest.approx(np.exp(-0.5))
    assert OdometryNoise().likelihood(prior, MOVED @ ahead(0.04), CONFIG) == 1.0, "not proven"


def exponentials(points: FloatArray, offsets: FloatArray, velocity: FloatArray) -> FloatArray:
    moved = [exp(offset * velocity)[:3] @ [*point, 1.0] for point, offset in zip(points, offsets, strict=True)]
    return np.array(moved)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-7, 0.0])
def test_equals_the_exponential_of_every_points_time_whose_logarithm_is_the_velocity(rng, scale):
    points = rng.normal(0.0, 10.0, (200, 3))
    offsets = rng.uniform(-0.1, 0.1, 200)
    velocity = np.array([3.0 * scale, -2.0 * scale, 5.0 * scale, 10.0, 2.0, -1.0])
    expected = exponentials(points, offsets, velocity)
    np.testing.assert_allclose(deskew(points, offsets, velocity, velocity), expected, atol=1e-9)
    np.testing.assert_allclose(body_velocity(exp(0.3 * velocity), 0.3), velocity, atol=1e-9)


@pytest.mark.parametrize(("low", "high"), [(-0.05, 0.05), (0.0, 0.1)])
def test_points_before_and_after_the_stamp_move_with_their_own_velocity(rng, low, high):
    points, offsets = rng.normal(0.0, 10.0, (200, 3)), rng.uniform(low, high, 200)
    before, after = rng.normal(size=(2, 6))
    ends = [exponentials(points, offsets, velocity) for velocity in (before, after)]
    expected = np.where(offsets[:, None] < 0.0, *ends)
    np.testing.assert_allclose(deskew(points, offsets, before, after), expected, atol=1e-9)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_a_sweep_of_a_sensor_that_turns_ever_faster_is_even_afterwards(room, stamp_at):
    """As on a walking robot: 20 deg/s faster at the end of the sweep than at its beginning."""
    velocity, acceleration = np.array([0.1, 0.5, 0.2, 1.0, 0.2, 0.0]), np.array([1.0, 3.5, -1.0, 0.0, 0.0, 0.0])

    def T_room_lidar_at(times: FloatArray) -> FloatArray:
        return exp(times[:, None] * velocity + 0.5 * times[:, None] ** 2 * acceleration)

    scan, middle_s = room.sweep(T_room_lidar_at, 0.0, stamp_at), 0.1 * (0.5 - stamp_at)
    sweep, mean = Sweep(scan.points, scan.time_offsets), velocity + middle_s * acceleration
    assert room.distance_to_surface(sweep.evened(acceleration[:3], middle_s).compensated(mean)).max() < 0.002
    assert room.distance_to_surface(sweep.compensated(mean)).max() > 0.02, "not so without"


INTERVAL_S = 0.1
STEADY = np.array([0.02, -0.01, 0.1, 5.0, 0.2, -0.1])  # rad/s, m/s
MOTION = exp(INTERVAL_S * STEADY)
BIAS = np.array([0.01, 0.0, -0.04, 0.1, -0.15, 0.05])
ALL = np.eye(6)  # every direction is observed
COVARIANCE = np.diag(np.array([0.001] * 3 + [0.01] * 3 + [0.02] * 3 + [0.2] * 3) ** 2)


def swept(number: int, velocity: FloatArray, seen_from_s: float) -> MotionState:
    """A scan of a sensor that moves steadily, with an estimate of its velocity."""
    T_world_lidar = exp(number * INTERVAL_S * STEADY)
    return MotionState(number * INTERVAL_S, T_world_lidar, velocity, COVARIANCE, INTERVAL_S - seen_from_s)


@pytest.mark.parametrize("share", [0.2, 1.0])
@pytest.mark.parametrize("seen_from_s", [0.0, 0.05, 0.1])
def test_a_bias_that_sweeps_and_map_have_in_common_fades_away(seen_from_s, share):
    """With stamps at the beginning of the sweeps, in their middle, and at their end; sweeps are a share of the map."""
    bias, last = BIAS, swept(0, STEADY + BIAS, seen_from_s)
    for number in range(1, 200):
        last = corrected_by_motion(swept(number, STEADY + bias, seen_from_s), last, seen_from_s, ALL)
        bias = bias + share * (last.velocity - STEADY - bias)
    np.testing.assert_allclose(last.velocity, STEADY, atol=0.01 * np.abs(BIAS).max())


def test_a_sudden_acceleration_is_no_bias():
    """Of 360 deg/s and 30 m/s, 0.9 degrees and 6 cm per second are corrected."""
    sudden = np.array([0.0, 0.0, np.deg2rad(360.0), 30.0, 0.0, 0.0])
    state = corrected_by_motion(swept(1, STEADY, 0.0), swept(0, STEADY - sudden, 0.0), 0.0, ALL)
    np.testing.assert_allclose((state.velocity - STEADY)[[2, 3]], [np.deg2rad(0.9), 0.06], rtol=1e-6)


def test_nothing_is_corrected_after_a_gap_between_sweeps():
    for last, now in ((0, 2), (1, 1)):
        state = swept(now, STEADY, 0.0)
        assert corrected_by_motion(state, swept(last, STEADY + BIAS, 0.0), 0.0, ALL) is state


def test_the_pose_follows_as_it_is_correlated():
    """Known best in the middle of a sweep, the pose at its begin goes back by half of the velocity's sweep."""
    covariance = COVARIANCE.copy()
    covariance[:6, 6:] = covariance[6:, :6] = -0.5 * INTERVAL_S * COVARIANCE[6:, 6:]
    state = MotionState(INTERVAL_S, MOTION, STEADY, covariance, INTERVAL_S)
    corrected = corrected_by_motion(state, swept(0, STEADY + BIAS, 0.0), 0.0, ALL)
    correction = corrected.velocity - STEADY
    np.testing.assert_allclose(log(inverse(MOTION) @ corrected.T_world_lidar), -0.05 * correction, atol=1e-12)
    assert np.abs(correction + 0.3 * BIAS).max() < 1e-12


def test_nothing_is_corrected_along_a_direction_that_was_not_observed():
    """As in a tunnel: the errors of position and velocity along it have grown together, and exceed all others."""
    covariance, along, across = COVARIANCE.copy(), np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), [0, 1, 2, 4, 5]
    covariance[[3, 9], [3, 9]], covariance[3, [9, 10]], covariance[9, 10] = 1.0, [0.9, 0.1], 0.1
    covariance = np.triu(covariance) + np.triu(covariance, 1).T
    state = MotionState(INTERVAL_S, MOTION, STEADY, covariance, INTERVAL_S)
    corrected = corrected_by_motion(state, swept(0, STEADY + BIAS, 0.0), 0.0, ALL - along)
    assert abs((corrected.velocity - STEADY)[3]) < 1e-12
    assert abs(log(inverse(MOTION) @ corrected.T_world_lidar)[3]) < 1e-12
    np.testing.assert_allclose((corrected.velocity - STEADY)[across], -0.3 * BIAS[across], atol=1e-12)
