"""The IMU on motions that are known: turns, even sweeps, bias, gravity, mounting, and what they give a scan's prior."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform, rotation_angle
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state import State
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.inertial.comparison import Comparison, MountingError, no_gravity
from lidarslam.mapping.inertial.inertial import UNKNOWN_LEVER_M, Inertial
from lidarslam.mapping.inertial.window import Preintegration
from lidarslam.mapping.motion.deskew import move
from lidarslam.mapping.motion.prediction import (
    UNKNOWN_VELOCITY,
    GravityDirection,
    MeasuredPose,
    MotionState,
    Prior,
    ProcessNoise,
    predict,
)
from lidarslam.mapping.tracking.mapped_scan import MappedScan

Path = Callable[[FloatArray], FloatArray]

RATE_HZ, PERIOD_S = 200.0, 0.1
T_LIDAR_IMU = exp([0.4, -0.3, 2.8, 0.05, -0.1, 0.08])
REGISTRATION = np.diag([np.deg2rad(0.1)] * 3 + [0.005] * 3) ** 2
# Chi square, six degrees of freedom, 1 in 1000.
CHI2_6 = 22.5
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


def shaken(times: FloatArray) -> FloatArray:
    """T_world_lidar (N, 4, 4) of a hand in a hurry, which accelerates along all axes."""
    t = np.asarray(times, dtype=np.float64)
    positions = np.stack([np.sin(2.1 * t), 0.8 * np.cos(1.7 * t), 0.1 * np.sin(6 * t)], axis=-1)
    return make_transform(walk(t)[..., :3, :3], positions)


def yaw_only(times: FloatArray) -> FloatArray:
    """T_world_lidar (N, 4, 4) of a carrier that turns about its vertical alone."""
    t = np.asarray(times, dtype=np.float64)
    angles = np.multiply.outer(np.sin(t), [0.0, 0.0, 1.0])
    return make_transform(Rotation.from_rotvec(angles).as_matrix(), np.zeros((*t.shape, 3)))


def samples(
    motion: Path, last_s: float, bias: FloatArray = BIAS, force_bias: FloatArray = FORCE_BIAS, scale: float = 1.0
) -> ImuSamples:
    """Noiseless samples of a motion, by central differences; its accelerations scaled."""
    stamps, h = np.arange(0.0, last_s, 1.0 / RATE_HZ), 1e-4
    before, now, after = (motion(stamps + step) @ T_LIDAR_IMU for step in (-h, 0.0, h))
    rates = log(inverse(before) @ after)[:, :3] / (2 * h)
    acceleration = scale * (before[:, :3, 3] - 2 * now[:, :3, 3] + after[:, :3, 3]) / h**2 + [0.0, 0.0, 9.81]
    forces = np.einsum("nij,ni->nj", now[:, :3, :3], acceleration)
    return ImuSamples(stamps, rates + bias, forces + force_bias, T_LIDAR_IMU)


def registered(
    state: MotionState | None, stamp: float, T: FloatArray, is_registered: bool = True, is_connected: bool = True
) -> MappedScan:
    """A scan that was registered to half a centimetre and a tenth of a degree, beside what was predicted of it."""
    covariance = UNKNOWN_VELOCITY.copy()
    covariance[:6, :6] = REGISTRATION
    measured = MotionState(stamp, T, np.zeros(6), covariance)
    if state is None:
        return MappedScan(measured, T, is_registered, Status.OK, is_connected=False)
    return MappedScan(
        state.fused(measured), state.T_world_lidar, is_registered, Status.OK,
        is_connected=is_connected, measured=MeasuredPose(T, np.linalg.inv(REGISTRATION)),
    )  # fmt: skip


def empty(stamp: float) -> Scan:
    return Scan(np.zeros((0, 3)), stamp)


def take(inertial: Inertial, stamp: float, T_world_lidar: FloatArray, **flags: bool) -> MotionState | None:
    """Give it a registered scan; the state that it predicted."""
    predicted = inertial.prior(empty(stamp), Prior()).inertial
    inertial.update(empty(stamp), registered(predicted, stamp, T_world_lidar, **flags))
    return predicted


def followed(
    inertial: Inertial, last_s: float, rng: np.random.Generator, motion: Path = walk
) -> list[tuple[float, GravityDirection]]:
    """Give it the scans of a motion, with errors, in a world that the first one makes; what it measures of gravity."""
    directions = []
    for stamp in np.arange(0.5, last_s, PERIOD_S):
        error = rng.normal(size=6) * ([np.deg2rad(0.03)] * 3 + [0.003] * 3)
        take(inertial, stamp, inverse(motion(0.5)) @ motion(stamp) @ exp(error))
        if inertial.direction is not None:
            directions.append((stamp, inertial.direction))
    return directions


def assert_predicted(state: MotionState, T_world_lidar: FloatArray, within_m: float) -> None:
    """A predicted pose is near the true one, and within the stated covariance."""
    error = log(inverse(state.T_world_lidar) @ T_world_lidar)
    assert np.linalg.norm(error[3:]) < within_m
    assert error @ np.linalg.solve(state.covariance[:6, :6], error) < CHI2_6


def angle_deg(a: FloatArray, b: FloatArray) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.fixture(scope="module")
def state_after_8_s() -> State:
    """Of an IMU that has followed the walk for that time."""
    inertial = Inertial(samples(walk, 9.0), T_LIDAR_IMU)
    followed(inertial, 8.0, np.random.default_rng(0))
    return inertial.state()


@pytest.fixture
def walked(state_after_8_s: State) -> Inertial:
    """It, with the samples of the rest of the walk."""
    inertial = Inertial(samples(walk, 20.0), T_LIDAR_IMU)
    inertial.restore(state_after_8_s)
    return inertial


def test_integrated_turns_are_those_of_the_motion():
    gyroscope = Preintegration(samples(walk, 4.0), T_LIDAR_IMU[:3, :3])
    turn = gyroscope.turn(0.513, 3.207, T_LIDAR_IMU[:3, :3] @ BIAS)
    expected = inverse(walk(0.513)) @ walk(3.207)
    assert np.rad2deg(rotation_angle(turn.T @ expected[:3, :3])) < 0.005
    back = gyroscope.turn(3.207, 0.513, T_LIDAR_IMU[:3, :3] @ BIAS)
    np.testing.assert_allclose(back, turn.T, atol=1e-4)


def test_clocks_that_count_from_1970_lose_no_digits():
    imu = samples(walk, 4.0)
    late = replace(imu, stamps=imu.stamps + 1.7e9)
    turns = [Preintegration(one, np.eye(3)).turn(t, t + 0.1, BIAS) for one, t in ((imu, 2.0), (late, 1.7e9 + 2.0))]
    np.testing.assert_allclose(turns[1], turns[0], atol=1e-6)


def test_a_gap_between_samples_is_not_covered():
    imu = samples(walk, 4.0)
    kept = (imu.stamps < 2.0) | (imu.stamps > 2.2)
    parts = imu.stamps[kept], imu.angular_velocities[kept], imu.accelerations[kept]
    gyroscope = Preintegration(ImuSamples(*parts), np.eye(3))
    assert gyroscope.covers(1.0, 1.9)
    assert gyroscope.covers(2.3, 3.99)
    for first_s, last_s in ((1.95, 2.05), (2.05, 2.15), (1.0, 3.0), (-0.5, 0.5), (3.5, 4.5)):
        assert not gyroscope.covers(first_s, last_s)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5])
def test_a_jerky_sweep_is_compensated_to_millimetres(stamp_at, rng):
    """By one angular velocity, once it is evened; the gyroscope's bias has no part in it."""
    stamp, offsets = 1.0, PERIOD_S * (np.sort(rng.uniform(size=3000)) - stamp_at)
    points = rng.uniform(-10.0, 10.0, (3000, 3))
    R = jerky(np.array(stamp))[:3, :3].T @ jerky(stamp + offsets)[:, :3, :3]
    sweep = Scan(np.einsum("nji,nj->ni", R, points), stamp, offsets)
    gyroscope = Preintegration(samples(jerky, 2.0), T_LIDAR_IMU[:3, :3])
    rate = gyroscope.mean_rate(sweep)
    velocity = np.concatenate([rate - T_LIDAR_IMU[:3, :3] @ BIAS, np.zeros(3)])
    errors = [move(one.points, offsets, velocity) - points for one in (sweep, gyroscope.evened(sweep))]
    raw, evened = (np.linalg.norm(error, axis=1).max() for error in errors)
    assert raw > 0.2
    assert evened < 0.007


def test_sweeps_without_times_or_samples_stay_as_they_are():
    gyroscope = Preintegration(samples(walk, 2.0), np.eye(3))
    points = np.ones((5, 3))
    for scan in (Scan(points, 1.0), Scan(points, 9.0, np.linspace(0.0, 0.1, 5)), Scan(points, 1.0, np.zeros(5))):
        assert gyroscope.evened(scan) is scan
        assert gyroscope.mean_rate(scan) is None


def test_biases_and_gravity_are_recovered(rng):
    inertial = Inertial(samples(walk, 15.0), T_LIDAR_IMU)
    directions = followed(inertial, 14.9, rng)
    np.testing.assert_allclose(inertial._window.last.bias[3:], T_LIDAR_IMU[:3, :3] @ BIAS, atol=1e-3)
    np.testing.assert_allclose(inertial._window.last.bias[:3], T_LIDAR_IMU[:3, :3] @ FORCE_BIAS, atol=0.02)
    up = walk(0.5)[:3, :3].T @ [0.0, 0.0, 1.0]
    assert [stamp for stamp, _ in directions] == pytest.approx(np.arange(directions[0][0], 14.9))
    assert directions[0][0] < 5.0
    stamp, last = directions[-1]
    assert angle_deg(last.world, up) < 0.15
    assert angle_deg(last.lidar, walk(stamp)[:3, :3].T @ [0.0, 0.0, 1.0]) < 0.15


def test_pose_and_velocity_are_predicted(walked):
    """To centimetres after a fifth of a second, and within the stated covariance; without it by decimetres."""
    stamp, h = 8.1, 1e-4
    state = walked.prior(empty(stamp), Prior()).inertial
    assert_predicted(state, inverse(walk(0.5)) @ walk(stamp), 0.02)
    assert np.rad2deg(rotation_angle(inverse(state.T_world_lidar) @ inverse(walk(0.5)) @ walk(stamp))) < 0.06
    velocity = log(inverse(walk(stamp - h)) @ walk(stamp + h)) / (2 * h)
    np.testing.assert_allclose(state.velocity, velocity, atol=0.06)


def test_it_predicts_through_scans_that_are_lost_and_ends_then(walked):
    before = walked._window.last.bias
    for stamp in np.arange(8.0, 9.9, PERIOD_S):
        state = take(walked, stamp, exp([0.0, 0.0, 2.0, 9.0, 9.0, 0.0]), is_registered=False, is_connected=False)
        assert_predicted(state, inverse(walk(0.5)) @ walk(stamp), 0.02 + 0.05 * (stamp - 7.9) ** 2)
    np.testing.assert_allclose(walked._window.last.bias, before, atol=1e-5)
    assert walked.prior(empty(10.2), Prior()).inertial is None
    take(walked, 10.0, exp([0.0, 0.0, 1.0, 9.0, 9.0, 0.0]), is_connected=False)
    assert walked.direction is None, "another place"
    np.testing.assert_allclose(walked._window.last.bias, before, atol=1e-5)


def test_a_direction_without_structure_is_held_by_the_imu(walked):
    """One axis of the world is registered to nothing for two seconds: a straight corridor, taken at changing speed."""
    stamps = np.arange(8.0, 10.0, PERIOD_S)
    for stamp in stamps:
        true = inverse(walk(0.5)) @ walk(stamp)
        state = walked.prior(empty(stamp), Prior()).inertial
        T_world_lidar = true.copy()
        T_world_lidar[0, 3] = state.T_world_lidar[0, 3]
        information = np.diag(1.0 / np.diag(REGISTRATION))
        across = true[:3, :3].T @ np.diag([0.0, 1.0, 1.0]) @ true[:3, :3]
        information[3:, 3:] = across / REGISTRATION[5, 5]
        covariance = state.covariance.copy()
        covariance[:6, :6] = np.linalg.inv(np.linalg.inv(state.covariance[:6, :6]) + information)
        found = MotionState(stamp, T_world_lidar, state.velocity, covariance)
        measured = MeasuredPose(T_world_lidar, information)
        walked.update(empty(stamp), MappedScan(found, state.T_world_lidar, True, Status.OK, measured=measured))
    state = walked.prior(empty(stamps[-1] + 1e-4), Prior()).inertial
    error = (state.T_world_lidar - inverse(walk(0.5)) @ walk(stamps[-1] + 1e-4))[0, 3]
    moved = np.linalg.norm(walk(stamps[-1])[:3, 3] - walk(stamps[0])[:3, 3])
    assert moved > 2.0
    assert abs(error) < 0.05
    variance = (state.T_world_lidar[:3, :3] @ state.covariance[3:6, 3:6] @ state.T_world_lidar[:3, :3].T)[0, 0]
    assert error**2 < 9.0 * variance < 0.3**2


def noisy(motion: Path, last_s: float, rng: np.random.Generator) -> ImuSamples:
    """Samples with white noise of an ordinary IMU."""
    exact = samples(motion, last_s)
    noise = rng.normal(size=(2, len(exact.stamps), 3))
    return replace(
        exact,
        angular_velocities=exact.angular_velocities + 0.003 * noise[0],
        accelerations=exact.accelerations + 0.03 * noise[1],
    )


def test_from_rest_a_corridor_is_passed_by_the_imu_alone(rng):
    """The registrations along it agree with any motion."""

    def departure(times: FloatArray) -> FloatArray:
        t = np.asarray(times, dtype=np.float64)
        along = 0.4 * np.maximum(0.0, t - 2.0) ** 2
        return make_transform(np.broadcast_to(np.eye(3), (*t.shape, 3, 3)), np.stack([along, 0 * t, 0 * t], axis=-1))

    inertial = Inertial(noisy(departure, 6.0, rng), T_LIDAR_IMU)
    information = np.diag([0.0 if axis == 3 else 1.0 / REGISTRATION[axis, axis] for axis in range(6)])
    rested = []
    for stamp in np.arange(0.3, 4.0, PERIOD_S):
        T, state = departure(stamp), inertial.prior(empty(stamp), Prior()).inertial
        mapped = registered(state, stamp, T, is_connected=state is not None)
        if state is not None:
            T = make_transform(T[:3, :3], [state.T_world_lidar[0, 3], 0.0, 0.0])
            mapped = replace(mapped, state=replace(state, T_world_lidar=T), measured=MeasuredPose(T, information))
        inertial.update(empty(stamp), mapped)
        rested.append(inertial.is_at_rest)
    assert rested == sorted(rested, reverse=True)
    assert 10 < sum(rested) < 18, "until it begins to move"
    state = inertial.prior(empty(4.0), Prior()).inertial
    assert_predicted(state, departure(4.0), 0.05)
    assert np.sqrt(state.covariance[3, 3]) < 0.2, "of 1.6 m"


def test_a_constant_velocity_is_no_rest(rng):
    """The samples are as steady; the registrations show the motion."""

    def glide(times: FloatArray) -> FloatArray:
        t = np.asarray(times, dtype=np.float64)
        return make_transform(
            np.broadcast_to(np.eye(3), (*t.shape, 3, 3)), np.stack([1.2 * (t - 0.3), 0 * t, 0 * t], axis=-1)
        )

    inertial = Inertial(noisy(glide, 3.0, rng), T_LIDAR_IMU)
    take(inertial, 0.3, glide(0.3))
    assert inertial.is_at_rest
    for stamp in np.arange(0.4, 2.0, PERIOD_S):
        take(inertial, stamp, glide(stamp))
        assert not inertial.is_at_rest
    assert not inertial.anew().may_rest
    assert_predicted(inertial.prior(empty(2.0), Prior()).inertial, glide(2.0), 0.03)


def test_reversed_time_gives_the_reversed_motion(rng):
    inertial = Inertial(samples(walk, 12.0), T_LIDAR_IMU).reversed(10.0)
    for stamp in np.arange(10.0, 16.0, PERIOD_S):
        state = take(inertial, stamp, inverse(walk(10.0)) @ walk(20.0 - stamp))
    true = inverse(walk(10.0)) @ walk(20.0 - stamp)
    assert np.linalg.norm(log(inverse(state.T_world_lidar) @ true)[3:]) < 0.01


@pytest.mark.long
def test_a_wrong_mounting_or_clock_is_noticed(walked, rng):
    imu, turned = samples(walk, 7.0), T_LIDAR_IMU @ exp([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    late = replace(imu, stamps=imu.stamps + 0.3)
    assert not any("mounting or clock is wrong" in warning for warning in walked.warnings)
    for wrong, T in ((imu, turned), (late, T_LIDAR_IMU)):
        inertial = Inertial(wrong, T)
        followed(inertial, 6.0, rng)
        assert any("the IMU's mounting or clock is wrong" in warning for warning in inertial.warnings)


@pytest.mark.long
def test_scaled_accelerations_and_an_unknown_lever_arm_are_recovered(rng):
    """Gravity is not scaled; the prediction is as good as without."""
    T_turned = make_transform(T_LIDAR_IMU[:3, :3], np.zeros(3))
    inertial = Inertial(samples(shaken, 20.0, scale=1.25), T_turned, UNKNOWN_LEVER_M)
    followed(inertial, 19.0, rng, shaken)
    assert "the IMU's accelerations are 1.25 times those of the LiDAR's positions" in inertial.warnings[-1]
    assert_predicted(inertial.prior(empty(19.4), Prior()).inertial, inverse(shaken(0.5)) @ shaken(19.4), 0.02)
    np.testing.assert_allclose(inertial.T_lidar_imu[:3, 3], T_LIDAR_IMU[:3, 3], atol=0.01)


def test_the_velocity_of_a_sweep_in_a_curve():
    """Begin and end of the sweep, moved by the predicted velocity, lie where the sensor was."""

    def curve(times: FloatArray) -> FloatArray:
        """T_world_lidar (N, 4, 4) at 5 m/s, turning at half a radian a second."""
        t = np.asarray(times, dtype=np.float64)
        R = Rotation.from_rotvec(np.multiply.outer(0.5 * t, [0.0, 0.0, 1.0])).as_matrix()
        return make_transform(R, 10.0 * np.stack([np.sin(0.5 * t), 1.0 - np.cos(0.5 * t), 0.0 * t], axis=-1))

    inertial = Inertial(samples(curve, 10.0), T_LIDAR_IMU)
    for stamp in np.arange(0.5, 9.0, PERIOD_S):
        take(inertial, stamp, inverse(curve(0.5)) @ curve(stamp))
    for begin_s in (-PERIOD_S, -0.5 * PERIOD_S, 0.0):
        offsets = begin_s + np.linspace(0.0, PERIOD_S, 50)
        state = inertial.prior(Scan(np.zeros((50, 3)), 9.1, offsets), Prior()).inertial
        for offset in offsets[[0, -1]]:
            ahead, true = exp(offset * state.velocity), inverse(curve(9.1)) @ curve(9.1 + offset)
            assert np.linalg.norm((ahead - true)[:3, 3]) < 0.006


def test_a_pose_measured_by_correspondences_alone(rng):
    """The minimum of their cost, and nothing along a direction that they do not constrain."""
    hessian, step = np.diag([900.0, 900.0, 900.0, 400.0, 400.0, 0.0]), 0.01 * rng.normal(size=6)
    T = exp(rng.normal(size=6))
    measured = MeasuredPose.minimum(T, hessian, -hessian @ step)
    np.testing.assert_allclose(measured.information, hessian, atol=1e-9)
    np.testing.assert_allclose(log(inverse(T) @ measured.T_world_lidar), step * [1, 1, 1, 1, 1, 0], atol=1e-9)


def test_a_measured_pose_without_a_direction(rng):
    """The marginal: nothing of the direction, and of others what is left when it is unknown."""
    root = rng.normal(size=(6, 6))
    information, direction = root @ root.T + np.eye(6), np.array([0.0, 0.0, 0.0, 0.6, 0.8, 0.0])
    left = MeasuredPose(np.eye(4), information).without(direction).information
    np.testing.assert_allclose(left @ direction, 0.0, atol=1e-9)
    others = np.linalg.svd(direction[None])[2][1:]
    unknown = np.linalg.inv(information) + 1e9 * np.outer(direction, direction)
    np.testing.assert_allclose(others @ left @ others.T, np.linalg.inv(others @ unknown @ others.T), rtol=1e-5)


def test_another_world_after_tracking_was_lost_has_another_vertical(walked):
    T_other_world = exp([0.2, -0.1, 0.4, 3.0, 0.0, 0.0])
    for stamp in np.arange(12.0, 16.0, PERIOD_S):
        state = take(walked, stamp, T_other_world @ walk(stamp))
    assert_predicted(state, T_other_world @ walk(stamp), 0.01)


def test_forces_without_gravity_are_refused():
    imu = samples(walk, 4.0)
    assert no_gravity(imu) is None
    assert "which is not gravity" in str(no_gravity(replace(imu, accelerations=0.0 * imu.accelerations)))


def test_states_are_fused_by_their_information(rng):
    """Gaussians on the tangent space: the mean of the product is where both gradients cancel."""
    roots = rng.normal(size=(2, 12, 12)) * 0.02
    P, Q = roots @ roots.swapaxes(1, 2) + 1e-6 * np.eye(12)
    away = 0.01 * rng.normal(size=12)
    first = MotionState(1.0, exp([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]), np.ones(6), P)
    other = MotionState(1.0, first.T_world_lidar @ exp(away[:6]), first.velocity + away[6:], Q)
    fused = first.fused(other)
    expected = np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(Q))
    mean = expected @ np.linalg.solve(Q, away)
    np.testing.assert_allclose(fused.covariance, expected, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(log(inverse(first.T_world_lidar) @ fused.T_world_lidar), mean[:6], atol=1e-9)
    np.testing.assert_allclose(fused.velocity - first.velocity, mean[6:], atol=1e-9)


def test_a_prediction_follows_the_imu_where_the_motion_is_uncertain():
    last = MotionState(0.0, np.eye(4), np.zeros(6), UNKNOWN_VELOCITY)
    velocity = np.array([0.0, 0.0, 2.0, 3.0, 1.0, 0.0])
    moved = MotionState(0.1, exp(0.1 * velocity), velocity, 1e-6 * np.eye(12))
    prediction = predict(last, 0.1, Prior(inertial=moved), ProcessNoise(), MappingConfig())
    np.testing.assert_allclose(prediction.T_world_lidar, moved.T_world_lidar, atol=1e-3)
    np.testing.assert_allclose(prediction.velocity, moved.velocity, atol=1e-2)
    assert prediction.is_held_within(0.02)
    assert prediction.holds(moved.T_world_lidar, 0.02)
    assert not prediction.holds(np.eye(4), 0.02)
    assert not predict(last, 0.1, Prior(), ProcessNoise(), MappingConfig()).is_held_within(100.0)


@pytest.mark.long
def test_large_biases_are_reported(rng):
    biased = samples(walk, 15.0, bias=np.deg2rad([1.0, -1.0, 0.5]), force_bias=np.array([0.4, 0.8, -0.3]))
    inertial = Inertial(biased, T_LIDAR_IMU)
    followed(inertial, 14.0, rng)
    forces, rates = inertial.warnings
    assert "the IMU's accelerometer has a bias of 0.10 g" in forces
    assert "the IMU's gyroscope has a bias of 1.50 deg/s" in rates


def compared(motion: Path, rng: np.random.Generator, imu: ImuSamples, T: FloatArray = T_LIDAR_IMU) -> Comparison:
    comparison = Comparison(imu, T)
    for stamp in np.arange(0.5, imu.stamps[-1] - 0.1, PERIOD_S):
        error = exp(rng.normal(size=6) * ([np.deg2rad(0.05)] * 3 + [0.005] * 3))
        comparison.add(float(stamp), motion(stamp) @ error, True)
    return comparison


def still(times: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(4), (*np.shape(times), 4, 4))


def test_the_mounting_is_recovered(rng):
    found = compared(walk, rng, samples(walk, 20.0), np.eye(4)).mounting()
    assert np.rad2deg(rotation_angle(found.R_lidar_imu.T @ T_LIDAR_IMU[:3, :3])) < 0.2
    assert found.sigma < np.deg2rad(1.0)


@pytest.mark.parametrize(
    ("motion", "last_s", "why"),
    [(yaw_only, 20.0, "one axis only"), (still, 20.0, "turns too little"), (walk, 2.5, "only 14 turns")],
)
def test_motions_that_show_no_mounting(motion, last_s, why, rng):
    with pytest.raises(MountingError, match=why):
        compared(motion, rng, samples(motion, last_s), np.eye(4)).mounting()


@pytest.mark.parametrize("late_s", [-0.02, 0.0])
def test_errors_of_clock_and_rotation_are_found_with_their_deviations(late_s, rng):
    imu, turned = samples(walk, 12.0), np.array([0.02, -0.03, 0.025])
    late = replace(imu, stamps=imu.stamps + late_s)
    wrong = exp(-np.pad(turned, (0, 3))) @ T_LIDAR_IMU
    found = compared(walk, rng, late, wrong).alignment()
    assert found.offset_s == pytest.approx(late_s, abs=4.0 * found.offset_sigma_s)
    assert found.offset_sigma_s < 0.001
    assert np.abs(found.rotation - turned).max() < 4.0 * found.rotation_sigma
    assert found.rotation_sigma < np.deg2rad(0.3)


def test_what_no_turn_shows_stays_unknown(rng):
    found = compared(still, rng, samples(still, 12.0)).alignment()
    assert found.offset_sigma_s > 0.09
    assert abs(found.offset_s) < 0.01
    assert found.rotation_sigma > np.deg2rad(4.0)


@pytest.mark.parametrize(
    ("rates", "forces", "seen"),
    [
        (np.eye(3), 1.0, None),
        (-np.eye(3), 1.0, "turns of the LiDAR about x, y are -x, -y of the gyroscope"),
        (np.eye(3)[[1, 0, 2]], 1.0, "turns of the LiDAR about x, y are +y, +x of the gyroscope"),
        (np.rad2deg(1.0) * np.eye(3), 1.0, "the gyroscope measures 57 times the turns"),
        (np.eye(3), -1.0, "opposed to those of the accelerometer"),
    ],
)
def test_signs_units_and_axes_that_cannot_be_right_are_seen(rates, forces, seen, rng):
    imu = samples(walk, 12.0)
    turns, pulls = (values @ T_LIDAR_IMU[:3, :3].T for values in (imu.angular_velocities, imu.accelerations))
    flawed = replace(imu, angular_velocities=turns @ rates, accelerations=forces * pulls)
    found = compared(walk, rng, flawed, make_transform(np.eye(3), T_LIDAR_IMU[:3, 3])).contradiction()
    assert found is None if seen is None else seen in str(found)
