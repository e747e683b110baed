"""Registrations of known truth: derivatives, weights, open directions, noise-free poses, and noisy covariances."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log, rotation_angle, transform_points
from lidarslam.core.tracking import Degeneracy
from lidarslam.mapping.motion.deskew import Sweep, move
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.gauss_newton import find_degeneracy, geman_mcclure, point_to_plane_jacobian
from lidarslam.mapping.registration.registration import Registration
from lidarslam.mapping.registration.registration import register as register_sweep
from lidarslam.mapping.registration.sampled_scan import sizes_of_cells
from lidarslam.mapping.surfels.surfel_map import SurfelMap

from .runs import assert_near
from .shapes import elevations_of, on_sides, surfel_map_of

CELL = 0.2
HALF = np.array([4.0, 3.0, 1.5])
T_TRUE = exp([0.02, -0.03, 0.5, 0.6, -0.4, 0.1])
TURNING = np.concatenate([np.deg2rad([0.0, 0.0, 120.0]), [1.5, 0.0, 0.0]])


def seen(world: FloatArray, T_world_lidar: FloatArray, times: FloatArray, velocity: FloatArray) -> FloatArray:
    """Points (N, 3) of the world as measured from where the sensor was at their times (N,)."""
    T_lidar_world = inverse(T_world_lidar @ exp(times[:, None] * velocity))
    return np.asarray(np.einsum("nij,nj->ni", T_lidar_world[:, :3, :3], world) + T_lidar_world[:, :3, 3])


def sweep_of(
    rng: np.random.Generator, velocity: FloatArray, T_world_lidar: FloatArray = T_TRUE, count: int = 2_000,
    stamp_at: float = 0.0, axes: tuple[int, ...] = (0, 1, 2),
) -> Sweep:  # fmt: skip
    """A rolling sweep of a tenth of a second, without noise."""
    times = 0.1 * rng.uniform(-stamp_at, 1.0 - stamp_at, count)
    return Sweep(seen(on_sides(rng, HALF, count, axes, margin_m=2.1 * CELL), T_world_lidar, times, velocity), times)


def snapshot(rng: np.random.Generator, T_world_lidar: FloatArray = T_TRUE, **wanted: Any) -> Sweep:
    return replace(sweep_of(rng, np.zeros(6), T_world_lidar, **wanted), times=None)


def predicted(
    T_world_lidar: FloatArray, velocity: FloatArray | None = None, rotation_deg: float = 60.0, metres: float = 2.0
) -> Prediction:
    """A prediction that is hardly trusted."""
    variances = np.array([np.deg2rad(rotation_deg)] * 3 + [metres] * 3) ** 2
    motion = np.zeros(6) if velocity is None else velocity
    return Prediction(0.0, T_world_lidar, motion, np.diag(np.concatenate([variances, 100.0 * variances])))


def register(sweep: Sweep, prediction: Prediction, surfel_map: SurfelMap) -> Registration:
    return register_sweep(sweep, prediction, surfel_map, with_velocity=True)


@pytest.fixture(scope="module")
def box_map() -> SurfelMap:
    rng = np.random.default_rng(5)
    return surfel_map_of(on_sides(rng, HALF, 60_000), CELL)


@pytest.mark.parametrize("seed", range(2))
def test_a_pose_is_found_from_ten_degrees_and_thirty_centimetres_away(box_map, seed):
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    off = exp(np.concatenate([np.deg2rad(10.0) * axes[0], 0.3 * axes[1]]))
    refined = register(snapshot(rng), predicted(T_TRUE @ off), box_map)
    assert_near(refined.T_world_lidar, T_TRUE, 1e-4, 0.002)
    assert len(refined.degeneracy) == 0


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_pose_and_velocity_of_a_rolling_sweep_are_found_from_rest(box_map, rng, stamp_at):
    """At 120 deg/s and 1.5 m/s the sweep is bent by 12 degrees and 15 cm."""
    refined = register(sweep_of(rng, TURNING, stamp_at=stamp_at), predicted(T_TRUE), box_map)
    assert_near(refined.T_world_lidar, T_TRUE, 2e-4, 0.005)
    np.testing.assert_allclose(refined.velocity[:3], TURNING[:3], atol=np.deg2rad(0.1))
    np.testing.assert_allclose(refined.velocity[3:], TURNING[3:], atol=0.005)


def test_a_rolling_sweep_of_known_velocity_is_registered_as_a_snapshot_is(box_map, rng):
    off = exp([0.0, 0.0, 0.05, 0.1, 0.0, 0.0])
    prediction = predicted(T_TRUE @ off, TURNING)
    refined = register_sweep(sweep_of(rng, TURNING), prediction, box_map, with_velocity=False)
    assert_near(refined.T_world_lidar, T_TRUE, 1e-4, 0.002)
    np.testing.assert_array_equal(refined.velocity, TURNING)


@pytest.fixture(scope="module")
def corridor_map() -> SurfelMap:
    return surfel_map_of(on_sides(np.random.default_rng(5), HALF, 60_000, axes=(1, 2)), CELL)


@pytest.mark.parametrize("along_m", [0.3, -0.7])
def test_along_a_corridor_the_prediction_is_kept_and_the_rest_corrected(corridor_map, rng, along_m):
    """The corridor goes along x of the world; sensor and prediction look elsewhere."""
    shift = np.eye(4)
    shift[0, 3] = along_m
    off = exp([0.02, -0.01, 0.03, 0.0, 0.0, 0.0])
    off[1:3, 3] = [0.08, -0.05]
    T_predicted = shift @ off @ T_TRUE
    refined = register(snapshot(rng, axes=(1, 2)), predicted(T_predicted), corridor_map)
    # Turned about the origin, the prediction has been moved along x as well.
    assert refined.T_world_lidar[0, 3] == pytest.approx(T_predicted[0, 3], abs=2e-3)
    np.testing.assert_allclose(refined.T_world_lidar[1:3, 3], T_TRUE[1:3, 3], atol=2e-4)
    assert np.rad2deg(rotation_angle(inverse(T_TRUE) @ refined.T_world_lidar)) < 0.005
    assert refined.degeneracy.names == ("x",)


def test_the_noise_of_a_corridors_walls_does_not_pull_along_it(rng):
    """Their normals are off by a little, and each would pull along the corridor a little."""
    noisy = on_sides(rng, HALF, 60_000, axes=(1, 2))
    local_map = surfel_map_of(noisy + rng.normal(0.0, 0.02, noisy.shape), CELL)
    sweep = snapshot(rng, axes=(1, 2))
    sweep = replace(sweep, points=sweep.points + rng.normal(0.0, 0.02, sweep.points.shape))
    refined = register(sweep, predicted(T_TRUE, metres=20.0), local_map)
    assert refined.degeneracy.names == ("x",)
    assert refined.T_world_lidar[0, 3] == pytest.approx(T_TRUE[0, 3], abs=2e-3)


def test_along_a_corridor_the_predicted_speed_is_kept_and_the_turn_found(corridor_map, rng):
    T_level = np.eye(4)
    truth = np.concatenate([np.deg2rad([0.0, 0.0, 20.0]), [1.0, 0.3, 0.0]])
    sweep = sweep_of(rng, truth, T_level, axes=(1, 2))
    guess = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])
    refined = register(sweep, predicted(T_level, guess), corridor_map)
    assert refined.velocity[3] == pytest.approx(0.4, abs=0.02)
    np.testing.assert_allclose(refined.velocity[:3], truth[:3], atol=np.deg2rad(0.5))
    np.testing.assert_allclose(refined.velocity[4:], truth[4:], atol=0.02)


@pytest.mark.parametrize(("count", "suffices"), [(0, False), (59, False), (100, True)])
def test_too_few_points_make_no_pose(box_map, rng, count, suffices):
    few = snapshot(rng, count=count)
    assert (register_sweep(few, predicted(T_TRUE), box_map, with_velocity=False) is not None) == suffices
    assert register_sweep(few, predicted(T_TRUE), SurfelMap(sizes_of_cells(CELL), 10.0), with_velocity=False) is None


def test_outliers_do_not_move_the_pose(box_map, rng):
    """A third of the points stands away from the walls, all on one side of them, as people and furniture do."""
    world = on_sides(rng, HALF, 3_000, margin_m=2.1 * CELL)
    world[::3] *= rng.uniform(0.8, 0.98, (1_000, 1))
    sweep = Sweep(transform_points(inverse(T_TRUE), world))
    off = exp([0.0, 0.01, 0.02, 0.05, -0.05, 0.0])
    assert_near(register(sweep, predicted(T_TRUE @ off), box_map).T_world_lidar, T_TRUE, 0.01, 0.1)


def test_the_covariance_has_its_order_and_its_frame(corridor_map, rng):
    """Turned left by 90 degrees, the sensor sees the corridor go along its own y."""
    T_turned = exp([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])
    prediction = predicted(T_turned, rotation_deg=3.0, metres=0.5)
    refined = register(snapshot(rng, T_turned, axes=(1, 2)), prediction, corridor_map)
    sigmas = np.sqrt(np.diag(refined.covariance)[:6])
    assert refined.degeneracy.names == ("y",)
    assert sigmas[4] == pytest.approx(0.5, rel=0.5), "the prediction's where nothing is seen"
    assert max(sigmas[3], sigmas[5]) < 0.02
    assert sigmas[:3].max() < np.deg2rad(1.0)


def noisy_scan(
    room: Any, seed: int, T_world_lidar: FloatArray, velocity: FloatArray, sigma_m: float, count: int
) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) as measured and their times (N,)."""
    rng = np.random.default_rng(seed)
    directions, fraction = room.directions(seed)
    chosen = rng.choice(len(directions), count, replace=False)
    directions, times = directions[chosen], 0.1 * fraction[chosen]
    T = T_world_lidar @ exp(times[:, None] * velocity)
    ranges = room.cast(T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], directions))
    return directions * (ranges + rng.normal(0.0, sigma_m, count))[:, None], times


def test_errors_are_as_large_as_the_covariance_says(room):
    """The mean of six squared normal variables is six. Errors are never understated, and not overstated tenfold.

    Of noisy sweeps, each with a map of three noisy sweeps from known poses along a way. All errors are independent and
    the covariance is cautious; on rough ground they are not, and it is about right.
    """
    velocity, sigma_m = np.array([0.0, 0.0, 0.3, 0.8, 0.05, 0.0]), 0.02
    start, squared = exp([0.0, 0.0, 0.3, -4.0, 0.0, -0.4]), []
    for seed in range(10):
        local_map = SurfelMap(sizes_of_cells(CELL), 100.0)
        for k in range(3):
            T = start @ exp(0.1 * k * velocity)
            points, times = noisy_scan(room, 100 * seed + k, T, velocity, sigma_m, 6_000)
            straight = move(points, times, velocity)
            local_map.insert(transform_points(T, straight), elevations_of(points), T[:3, 3])
        T_true = start @ exp(0.3 * velocity)
        points, times = noisy_scan(room, 100 * seed + 3, T_true, velocity, sigma_m, 2_500)
        off = exp(np.random.default_rng(seed).normal(0.0, [np.deg2rad(1.0)] * 3 + [0.05] * 3))
        refined = register(Sweep(points, times), predicted(T_true @ off, velocity), local_map)
        errors = log(inverse(refined.T_world_lidar) @ T_true), velocity - refined.velocity
        parts = refined.covariance[:6, :6], refined.covariance[6:, 6:]
        squared.append([error @ np.linalg.solve(P, error) for error, P in zip(errors, parts, strict=True)])
    means = np.mean(squared, axis=0)
    assert (means > 6.0 / 10.0**2).all()
    assert (means < 6.0).all()


Scene = tuple[FloatArray, FloatArray]


def test_the_jacobian_is_the_derivative_with_a_motion_from_the_right(rng):
    points, normals = rng.normal(size=(2, 20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    J, step = point_to_plane_jacobian(points, normals), 1e-6
    for axis in range(6):
        ahead, behind = (transform_points(exp(sign * step * np.eye(6)[axis]), points) for sign in (1.0, -1.0))
        numeric = np.einsum("ij,ij->i", ahead - behind, normals) / (2.0 * step)
        np.testing.assert_allclose(J[:, axis], numeric, atol=1e-8)


def test_weights_are_one_nearby_and_vanish_far_away():
    weights = geman_mcclure(np.array([0.0, 0.1, 10.0]), 0.1**2)
    np.testing.assert_allclose(weights, [1.0, 0.25, 0.0], atol=1e-7)


def wall(rng: np.random.Generator, axis: int, at: float, reach: tuple[float, float, float], count: int = 500) -> Scene:
    """Points (N, 3) on a wall across an axis, and their normals."""
    points = rng.uniform(-1.0, 1.0, (count, 3)) * reach
    points[:, axis] = at
    return points, np.tile(np.eye(3)[axis], (count, 1))


def joined(*scenes: Scene) -> Scene:
    return np.concatenate([points for points, _ in scenes]), np.concatenate([normals for _, normals in scenes])


def corridor(rng: np.random.Generator, count: int = 500) -> Scene:
    reach = (10.0, 1.2, 1.3)
    return joined(*[wall(rng, axis, sign * reach[axis], reach, count) for axis in (1, 2) for sign in (-1, 1)])


def closed_room(rng: np.random.Generator) -> Scene:
    reach = (5.0, 4.0, 1.5)
    return joined(*[wall(rng, axis, sign * reach[axis], reach) for axis in range(3) for sign in (-1, 1)])


def round_tunnel(rng: np.random.Generator) -> Scene:
    angle = rng.uniform(-np.pi, np.pi, 2_000)
    normals = np.column_stack([np.zeros(2_000), np.cos(angle), np.sin(angle)])
    return 3.0 * normals + np.column_stack([rng.uniform(-15, 15, 2_000), np.zeros((2_000, 2))]), normals


def find(scene: Scene, tilt: float = 0.0, weight: float = 1.0) -> Degeneracy:
    count = len(scene[0])
    lever_m = float(np.sqrt((scene[0] ** 2).sum(axis=1).mean()))
    return find_degeneracy(point_to_plane_jacobian(*scene), np.full(count, weight), np.full(count, tilt), lever_m)


def tilted(rng: np.random.Generator, scene: Scene, sigma: float) -> Scene:
    normals = scene[1] + rng.normal(0.0, sigma, scene[1].shape)
    return scene[0], normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("tilt", [0.0, 0.02, 0.05])
def test_a_corridor_leaves_its_own_direction_open_however_noisy(rng, tilt):
    found = find(tilted(rng, corridor(rng), tilt), tilt)
    assert found.names == ("x",)
    assert abs(found.directions[0, 3]) > 0.99
    closed = joined(corridor(rng), wall(rng, 0, 9.0, (9.0, 1.2, 1.3), 40))
    weights = np.ones(len(closed[0]))
    assert len(find(closed)) == 0
    weights[2_000:] = 0.0
    assert find_degeneracy(point_to_plane_jacobian(*closed), weights, np.zeros(len(weights)), 6.0).names == ("x",)


def field(rng: np.random.Generator) -> Scene:
    return wall(rng, 2, -1.5, (20.0, 20.0, 0.0), 2_000)


@pytest.mark.parametrize(("scene", "tilt", "names"), [
    (closed_room, 0.0, []), (closed_room, 0.02, []),
    (round_tunnel, 0.0, ["roll", "x"]), (field, 0.0, ["x", "y", "yaw"]),
])  # fmt: skip
def test_what_a_scene_leaves_open(rng, scene, tilt, names):
    assert sorted(find(tilted(rng, scene(rng), tilt), tilt).names) == names


def test_each_open_direction_has_a_name_of_its_own():
    """Any basis of the same directions may come out of the eigenvalue problem."""
    half = 0.5**0.5
    directions = np.zeros((2, 6))
    directions[0, [3, 4]] = half * np.array([1.0 + 1e-9, 1.0])
    directions[1, [3, 4]] = half * np.array([1.0 + 1e-9, -1.0])
    assert sorted(Degeneracy(directions, 5.0).names) == ["x", "y"]


@pytest.mark.parametrize("weight", [1e-6, 1e6])
def test_the_unit_of_the_weights_does_not_matter(rng, weight):
    scene = tilted(rng, corridor(rng), 0.02)
    np.testing.assert_allclose(find(scene, 0.02, weight).projector(), find(scene, 0.02).projector(), atol=1e-9)


@pytest.mark.parametrize("metres", [0.05, 30.0])
def test_the_size_of_the_scene_does_not_matter(rng, metres):
    for scene in (corridor(rng), closed_room(rng), round_tunnel(rng)):
        assert len(find((metres * scene[0], scene[1]))) == len(find(scene))


def test_without_any_match_everything_is_open():
    found = find_degeneracy(np.zeros((0, 6)), np.zeros(0), np.zeros(0), 5.0)
    assert set(found.names) == {"roll", "pitch", "yaw", "x", "y", "z"}


def test_the_projector_measures_a_motion_along_the_open_directions_in_metres(rng):
    found = find(round_tunnel(rng))
    P = found.projector()
    turn, shift, closed = np.zeros((3, 6))
    turn[0], shift[3], closed[[1, 2, 4, 5]] = 0.1, 0.2, 1.0
    assert turn @ P @ turn == pytest.approx((found.lever_m * 0.1) ** 2, rel=1e-3)
    assert shift @ P @ shift == pytest.approx(0.2**2, rel=1e-3)
    assert closed @ P @ closed == pytest.approx(0.0, abs=0.01 * found.lever_m**2)
