"""The IMU on motions that are known: turns, even sweeps, bias, gravity, mounting, and what they give a scan's prior."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform, rotation_angle
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state.stateful import Saved, State
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.inertial.gyroscope import Gyroscope
from lidarslam.mapping.inertial.inertial import Inertial, fuse_turn
from lidarslam.mapping.inertial.mounting import MountingError, Turns, find_mounting
from lidarslam.mapping.motion.deskew import move
from lidarslam.mapping.motion.prediction import (
    UNKNOWN_VELOCITY,
    GravityDirection,
    MotionState,
    Prior,
    ProcessNoise,
    predict,
)
from lidarslam.mapping.tracking.mapped_scan import MappedScan

RATE_HZ, PERIOD_S = 200.0, 0.1
T_LIDAR_IMU = exp([0.4, -0.3, 2.8, 0.05, -0.1, 0.08])
BIAS, FORCE_BIAS = np.array([0.012, -0.008, 0.015]), np.array([0.05, -0.04, 0.03])


def walk(times: FloatArray) -> FloatArray:
    """T_world_lidar (N, 4, 4) of a hand: it turns about all axes and goes round."""
    t = np.asarray(times, dtype=np.float64)
    R = Rotation.from_rotvec(np.stack([0.3 * np.sin(2 * t), 0.25 * np.sin(2.7 * t + 1), 0.6 * t], axis=-1)).as_matrix()
    return make_transform(R, np.stack([3 * np.sin(0.4 * t), 3 * np.cos(0.4 * t), 0.1 * np.sin(3 * t)], axis=-1))


def jerky(times: FloatArray) -> FloatArray:
    """T_world_lidar (N, 4, 4) of a sensor that is shaken within each sweep, on the spot."""
    t = np.asarray(times, dtype=np.float64)
    vectors = np.stack([0.05 * np.sin(40 * t), 0.05 * np.sin(31 * t), 0.5 * t + 0.08 * np.sin(25 * t)], axis=-1)
    return make_transform(Rotation.from_rotvec(vectors).as_matrix(), np.zeros((*t.shape, 3)))


def yaw_only(times: FloatArray) -> FloatArray:
    """T_world_lidar (N, 4, 4) of a carrier that turns about its vertical alone."""
    t = np.asarray(times, dtype=np.float64)
    angles = np.multiply.outer(np.sin(t), [0.0, 0.0, 1.0])
    return make_transform(Rotation.from_rotvec(angles).as_matrix(), np.zeros((*t.shape, 3)))


def samples(
    motion: Callable[[FloatArray], FloatArray],
    last_s: float,
    bias: FloatArray = BIAS,
    force_bias: FloatArray = FORCE_BIAS,
) -> ImuSamples:
    """Noiseless samples of a motion, by central differences."""
    stamps, h = np.arange(0.0, last_s, 1.0 / RATE_HZ), 1e-4
    before, now, after = (motion(stamps + step) @ T_LIDAR_IMU for step in (-h, 0.0, h))
    rates = log(inverse(before) @ after)[:, :3] / (2 * h)
    acceleration = (before[:, :3, 3] - 2 * now[:, :3, 3] + after[:, :3, 3]) / h**2 + [0.0, 0.0, 9.81]
    forces = np.einsum("nij,ni->nj", now[:, :3, :3], acceleration)
    return ImuSamples(stamps, rates + bias, forces + force_bias, T_LIDAR_IMU)


def mapped(stamp: float, T_world_lidar: FloatArray, registered: bool = True, connected: bool = True) -> MappedScan:
    """A scan that was registered to half a centimetre and a tenth of a degree."""
    covariance = UNKNOWN_VELOCITY.copy()
    covariance[:6, :6] = np.diag([np.deg2rad(0.1)] * 3 + [0.005] * 3) ** 2
    state = MotionState(stamp, T_world_lidar, np.zeros(6), covariance)
    return MappedScan(state, T_world_lidar, registered, Status.OK, is_connected=connected)


def empty(stamp: float) -> Scan:
    return Scan(np.zeros((0, 3)), stamp)


def followed(
    inertial: Inertial, last_s: float, rng: np.random.Generator, tilt: Callable[[float], FloatArray] | None = None
) -> list[GravityDirection]:
    """Give it the scans of the walk, with errors, in a world that the first one makes; what it says of gravity."""
    directions = []
    for stamp in np.arange(0.5, last_s, PERIOD_S):
        true = inverse(walk(0.5)) @ walk(stamp)
        if tilt is not None:
            true = make_transform(tilt(stamp) @ true[:3, :3], true[:3, 3])
        error = rng.normal(size=6) * ([np.deg2rad(0.03)] * 3 + [0.003] * 3)
        inertial.prior(empty(stamp), Prior())
        inertial.update(empty(stamp), mapped(stamp, true @ exp(error)))
        if inertial.direction is not None:
            directions.append(inertial.direction)
    return directions


def angle_deg(a: FloatArray, b: FloatArray) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def test_integrated_turns_are_those_of_the_motion() -> None:
    gyroscope = Gyroscope(samples(walk, 4.0), T_LIDAR_IMU[:3, :3])
    turn = gyroscope.turn(0.513, 3.207, T_LIDAR_IMU[:3, :3] @ BIAS)
    expected = inverse(walk(0.513)) @ walk(3.207)
    assert np.rad2deg(rotation_angle(turn.T @ expected[:3, :3])) < 0.005
    back = gyroscope.turn(3.207, 0.513, T_LIDAR_IMU[:3, :3] @ BIAS)
    np.testing.assert_allclose(back, turn.T, atol=1e-4)


def test_clocks_that_count_from_1970_lose_no_digits() -> None:
    imu = samples(walk, 4.0)
    late = replace(imu, stamps=imu.stamps + 1.7e9)
    turns = [Gyroscope(one, np.eye(3)).turn(t, t + 0.1, BIAS) for one, t in ((imu, 2.0), (late, 1.7e9 + 2.0))]
    np.testing.assert_allclose(turns[1], turns[0], atol=1e-6)


def test_a_gap_between_samples_is_not_covered() -> None:
    imu = samples(walk, 4.0)
    kept = (imu.stamps < 2.0) | (imu.stamps > 2.2)
    gyroscope = Gyroscope(
        ImuSamples(imu.stamps[kept], imu.angular_velocities[kept], imu.accelerations[kept]), np.eye(3)
    )
    assert gyroscope.covers(1.0, 1.9)
    assert gyroscope.covers(2.3, 3.99)
    for first_s, last_s in ((1.95, 2.05), (2.05, 2.15), (1.0, 3.0), (-0.5, 0.5), (3.5, 4.5)):
        assert not gyroscope.covers(first_s, last_s)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_a_jerky_sweep_is_compensated_to_millimetres(stamp_at: float, rng: np.random.Generator) -> None:
    """By one angular velocity, once it is evened; the gyroscope's bias has no part in it."""
    stamp, offsets = 1.0, PERIOD_S * (np.sort(rng.uniform(size=3000)) - stamp_at)
    points = rng.uniform(-10.0, 10.0, (3000, 3))
    R = jerky(np.array(stamp))[:3, :3].T @ jerky(stamp + offsets)[:, :3, :3]
    sweep = Scan(np.einsum("nji,nj->ni", R, points), stamp, offsets)
    gyroscope = Gyroscope(samples(jerky, 2.0), T_LIDAR_IMU[:3, :3])
    rate = gyroscope.mean_rate(sweep)
    assert rate is not None
    velocity = np.concatenate([rate - T_LIDAR_IMU[:3, :3] @ BIAS, np.zeros(3)])
    raw, evened = (
        np.linalg.norm(move(scan.points, offsets, velocity) - points, axis=1).max()
        for scan in (sweep, gyroscope.evened(sweep))
    )
    assert raw > 0.2
    assert evened < 0.007


def test_sweeps_without_times_or_samples_stay_as_they_are() -> None:
    gyroscope = Gyroscope(samples(walk, 2.0), np.eye(3))
    points = np.ones((5, 3))
    for scan in (Scan(points, 1.0), Scan(points, 9.0, np.linspace(0.0, 0.1, 5)), Scan(points, 1.0, np.zeros(5))):
        assert gyroscope.evened(scan) is scan
        assert gyroscope.mean_rate(scan) is None


def test_bias_and_gravity_are_recovered(rng: np.random.Generator) -> None:
    inertial = Inertial(samples(walk, 20.0), T_LIDAR_IMU, MappingConfig())
    directions = followed(inertial, 19.9, rng)
    np.testing.assert_allclose(inertial._bias.bias, T_LIDAR_IMU[:3, :3] @ BIAS, atol=1e-3)
    np.testing.assert_allclose(inertial._gravity._bias, T_LIDAR_IMU[:3, :3] @ FORCE_BIAS, atol=0.02)
    up = walk(0.5)[:3, :3].T @ [0.0, 0.0, 1.0]
    assert len(directions) >= 15
    assert angle_deg(directions[-1].world, up) < 0.15
    assert max(angle_deg(one.world, up) for one in directions) < 1.0


def test_a_tilted_world_shows_in_the_direction_of_gravity(rng: np.random.Generator) -> None:
    """Registered poses that lean more and more: what is measured leans the other way."""

    def lean(stamp: float) -> FloatArray:
        return exp([np.deg2rad(3.0) * max(0.0, stamp - 15.0) / 5.0, 0.0, 0.0, 0.0, 0.0, 0.0])[:3, :3]

    inertial = Inertial(samples(walk, 20.0), T_LIDAR_IMU, MappingConfig())
    last = followed(inertial, 19.9, rng, lean)[-1]
    true = walk(19.8)[:3, :3].T @ [0.0, 0.0, 1.0]
    expected = (lean(19.8) @ (inverse(walk(0.5)) @ walk(19.8))[:3, :3]).T @ last.world
    assert angle_deg(last.lidar, true) < 0.7
    assert angle_deg(last.lidar, expected) > 1.0


def test_the_prior_is_the_turn_and_goes_on_otherwise(rng: np.random.Generator) -> None:
    inertial = Inertial(samples(walk, 10.0), T_LIDAR_IMU, MappingConfig())
    followed(inertial, 8.0, rng)
    stamp = inertial._last.stamp  # type: ignore[union-attr]
    prior = inertial.prior(empty(stamp + PERIOD_S), Prior())
    true = inverse(walk(stamp)) @ walk(stamp + PERIOD_S)
    assert prior.T_prev_curr is not None
    assert prior.covariance is not None
    assert np.rad2deg(rotation_angle(prior.T_prev_curr[:3, :3].T @ true[:3, :3])) < 0.03
    assert np.linalg.norm(prior.T_prev_curr[:3, 3] - true[:3, 3]) < 0.05
    assert MappingConfig().prior_caution ** 2 * prior.covariance[0, 0] < np.deg2rad(0.1) ** 2


def test_a_lost_scan_changes_no_bias(rng: np.random.Generator) -> None:
    inertial = Inertial(samples(walk, 10.0), T_LIDAR_IMU, MappingConfig())
    followed(inertial, 8.0, rng)
    before = inertial._bias.bias.copy()
    stamp = inertial._last.stamp + PERIOD_S  # type: ignore[union-attr]
    inertial.update(empty(stamp), mapped(stamp, exp([0.0, 0.0, 2.0, 9.0, 9.0, 0.0]), registered=False, connected=False))
    inertial.update(empty(stamp + 0.1), mapped(stamp + 0.1, exp([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), connected=False))
    assert inertial.direction is None
    np.testing.assert_array_equal(inertial._bias.bias, before)


def test_a_wrong_mounting_or_clock_is_noticed(rng: np.random.Generator) -> None:
    imu, turned = samples(walk, 10.0), T_LIDAR_IMU @ exp([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    late = replace(imu, stamps=imu.stamps + 0.3)
    for wrong, T in ((imu, T_LIDAR_IMU), (imu, turned), (late, T_LIDAR_IMU)):
        inertial = Inertial(wrong, T, MappingConfig())
        followed(inertial, 9.0, rng)
        is_right = wrong is imu and T is T_LIDAR_IMU
        assert (inertial.disagreement is None) == is_right
    assert "the IMU's mounting or clock is wrong" in str(inertial.disagreement)


def test_the_fused_motion_is_the_mean_weighted_by_information(rng: np.random.Generator) -> None:
    """Of Gaussians on the tangent space; the translation follows as the covariance has it."""
    root = rng.normal(size=(6, 6)) * 0.02
    covariance, turn_covariance = root @ root.T + 1e-6 * np.eye(6), np.diag([1e-5, 2e-5, 3e-5])
    motion, error = exp([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]), np.array([0.001, -0.002, 0.0015])
    turn = motion[:3, :3] @ exp(np.concatenate([error, np.zeros(3)]))[:3, :3]
    information, of_turn = np.linalg.inv(covariance), np.zeros((6, 6))
    of_turn[:3, :3] = np.linalg.inv(turn_covariance)
    expected = np.linalg.inv(information + of_turn)
    mean = expected @ of_turn @ np.concatenate([error, np.zeros(3)])
    fused, fused_covariance = fuse_turn(motion, covariance, turn, turn_covariance)
    np.testing.assert_allclose(fused_covariance, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(log(inverse(motion) @ fused), mean, atol=1e-6)


def test_gravity_turns_the_predicted_pose_about_its_horizontal_axes() -> None:
    """By the share of the information; its heading and place stay."""
    lean, yaw = np.deg2rad(2.0), 0.7
    tilted = exp([0.0, 0.0, yaw, 1.0, 2.0, 3.0]) @ exp([lean, 0.0, 0.0, 0.0, 0.0, 0.0])
    covariance = np.zeros((12, 12))
    covariance[:6, :6] = np.diag([np.deg2rad(1.0)] * 3 + [0.1] * 3) ** 2
    last = MotionState(0.0, tilted, np.zeros(6), covariance)
    up = np.array([0.0, 0.0, 1.0])
    measured = GravityDirection(np.array([0.0, 0.0, 1.0]), up, np.eye(3) * np.deg2rad(0.01) ** 2)
    none = ProcessNoise(0.0, 0.0)
    prediction = predict(last, 0.1, Prior(gravity=measured), none, MappingConfig())
    assert angle_deg(prediction.T_world_lidar[:3, :3].T @ up, measured.lidar) < 0.01
    expected = exp([0.0, 0.0, yaw, 0.0, 0.0, 0.0])[:3, :3]
    np.testing.assert_allclose(prediction.T_world_lidar[:3, :3], expected, atol=1e-3)
    np.testing.assert_allclose(prediction.T_world_lidar[:3, 3], tilted[:3, 3], atol=1e-6)


def turns_of(motion: Callable[[FloatArray], FloatArray], rng: np.random.Generator, imu: ImuSamples) -> Turns:
    turns = Turns(imu)
    for stamp in np.arange(0.5, imu.stamps[-1] - 0.1, PERIOD_S):
        error = exp(np.concatenate([rng.normal(size=3) * np.deg2rad(0.05), np.zeros(3)]))
        turns.add(float(stamp), (motion(stamp) @ error)[:3, :3], True)
    return turns


def test_the_mounting_is_recovered_with_the_bias(rng: np.random.Generator) -> None:
    found = find_mounting(turns_of(walk, rng, samples(walk, 20.0)))
    assert np.rad2deg(rotation_angle(found.R_lidar_imu.T @ T_LIDAR_IMU[:3, :3])) < 0.5
    np.testing.assert_allclose(found.bias, BIAS, atol=2e-3)
    assert found.sigma < np.deg2rad(1.0)


def test_turns_about_one_axis_show_no_mounting(rng: np.random.Generator) -> None:
    with pytest.raises(MountingError, match="one axis only"):
        find_mounting(turns_of(yaw_only, rng, samples(yaw_only, 20.0)))


def test_a_sensor_at_rest_shows_no_mounting(rng: np.random.Generator) -> None:
    def still(times: FloatArray) -> FloatArray:
        return np.broadcast_to(np.eye(4), (*np.shape(times), 4, 4))

    with pytest.raises(MountingError, match="turns too little"):
        find_mounting(turns_of(still, rng, samples(still, 20.0)))


def test_another_clock_shows_no_mounting(rng: np.random.Generator) -> None:
    imu = samples(walk, 20.0)
    late = replace(imu, stamps=imu.stamps + 0.7)
    with pytest.raises(MountingError, match=r"different clocks|one axis only"):
        find_mounting(turns_of(walk, rng, late))


def test_too_few_turns_show_no_mounting(rng: np.random.Generator) -> None:
    with pytest.raises(MountingError, match="only 6 turns"):
        find_mounting(turns_of(walk, rng, samples(walk, 4.0)))


def test_restored_it_goes_on_alike(rng: np.random.Generator, through_disk: Callable[[State], Saved]) -> None:
    """To the last bit, in the middle of a span of gravity."""
    imu = samples(walk, 12.0)
    begun, resumed = (Inertial(imu, T_LIDAR_IMU, MappingConfig()) for _ in range(2))
    followed(begun, 8.0, rng)
    resumed.restore(through_disk(begun.state()))
    for number in range(30):
        stamp = 8.0 + number * PERIOD_S
        pose = inverse(walk(0.5)) @ walk(stamp)
        priors = [one.prior(empty(stamp), Prior()) for one in (begun, resumed)]
        np.testing.assert_array_equal(priors[0].T_prev_curr, priors[1].T_prev_curr)
        np.testing.assert_array_equal(priors[0].covariance, priors[1].covariance)
        for one in (begun, resumed):
            one.update(empty(stamp), mapped(stamp, pose))
        assert (begun.direction is None) == (resumed.direction is None)
        if begun.direction is not None and resumed.direction is not None:
            np.testing.assert_array_equal(begun.direction.lidar, resumed.direction.lidar)
