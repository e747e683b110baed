"""Maps of feature points, their lines and planes, and the registration of features to them, against known truth."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse, log, transform_points
from lidarslam.core.state.stateful import Saved, State
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.loam import registration
from lidarslam.mapping.loam.feature_map import FeatureMap, match_lines, match_planes
from lidarslam.mapping.loam.features import Features
from lidarslam.mapping.loam.neighbour_kernels import write_principal_axes
from lidarslam.mapping.loam.registration import FeatureMaps, LoamRegistration
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import UNKNOWN_VELOCITY, MotionState

ThroughDisk = Callable[[State], Saved]
ORIGIN = np.zeros(3)


def map_of(points: FloatArray, spacing_m: float = 0.01, radius_m: float = 100.0) -> FeatureMap:
    feature_map = FeatureMap(radius_m)
    feature_map.insert(points, ORIGIN, spacing_m)
    return feature_map


def register(
    edges: FloatArray, planes: FloatArray, T_predicted: FloatArray, covariance: FloatArray, maps: FeatureMaps,
    spacing_m: float,
) -> LoamRegistration | None:  # fmt: skip
    """Register compensated features, with a covariance (6, 6) of the prediction."""
    both = UNKNOWN_VELOCITY.copy()
    both[:6, :6] = covariance
    predicted = MotionState(0.0, T_predicted, np.zeros(6), both)
    return registration.register(Features(Sweep(edges), Sweep(planes), spacing_m, 0.0), predicted, maps, 10_000)


def rows(points: FloatArray) -> list[tuple[float, ...]]:
    return sorted(map(tuple, points.tolist()))


def test_a_map_holds_the_first_point_of_each_voxel(rng: np.random.Generator) -> None:
    clouds = [rng.uniform(-3.0, 3.0, (2000, 3)) for _ in range(3)]
    feature_map, first = FeatureMap(100.0), {}
    for cloud in clouds:
        feature_map.insert(cloud, ORIGIN, 0.5)
        for point in cloud.tolist():
            first.setdefault(tuple(np.floor(np.array(point) / 0.5)), tuple(point))
    assert rows(feature_map.points) == sorted(first.values())
    assert len(feature_map) == len(first)


def test_points_beyond_the_radius_are_dropped(rng: np.random.Generator) -> None:
    points = rng.uniform(-10.0, 10.0, (2000, 3))
    feature_map = map_of(points, radius_m=6.0)
    assert rows(feature_map.points) == rows(points[np.linalg.norm(points, axis=1) < 6.0])
    sensor = np.array([5.0, 0.0, 0.0])
    feature_map.insert(np.empty((0, 3)), sensor, 0.01)
    both = (np.linalg.norm(points, axis=1) < 6.0) & (np.linalg.norm(points - sensor, axis=1) < 6.0)
    assert rows(feature_map.points) == rows(points[both])


def test_another_spacing_holds_for_the_points_of_before(rng: np.random.Generator) -> None:
    feature_map = map_of(rng.uniform(-3.0, 3.0, (2000, 3)), 0.2)
    before = feature_map.points
    feature_map.insert(rng.uniform(-3.0, 3.0, (2000, 3)), ORIGIN, 1.0)
    assert len(feature_map) == 216
    assert len(np.unique(np.floor(feature_map.points), axis=0)) == 216
    assert set(rows(feature_map.points)) <= set(rows(before)), "all voxels were taken"
    feature_map.insert(rng.uniform(-3.0, 3.0, (2000, 3)), ORIGIN, 0.2)
    assert len(feature_map) > 1500


def test_a_restored_map_goes_on(rng: np.random.Generator, through_disk: ThroughDisk) -> None:
    whole, restored = map_of(rng.uniform(-4.0, 4.0, (3000, 3)), 0.3), FeatureMap(100.0)
    restored.restore(through_disk(whole.state()))
    queries = rng.uniform(-4.0, 4.0, (500, 3))
    for _ in range(2):
        for name, value in vars(whole.neighbourhoods(queries, 0)).items():
            np.testing.assert_array_equal(getattr(restored.neighbourhoods(queries, 0), name), value)
        more = rng.uniform(-5.0, 5.0, (3000, 3))
        whole.insert(more, ORIGIN, 0.3)
        restored.insert(more, ORIGIN, 0.3)
        np.testing.assert_array_equal(restored.points, whole.points)


@pytest.mark.parametrize("forge", [lambda p: p[::-1].copy(), lambda p: np.concatenate([p[:1], p])])
def test_points_out_of_order_are_refused(
    rng: np.random.Generator, through_disk: ThroughDisk, forge: Callable[[FloatArray], FloatArray]
) -> None:
    state = map_of(rng.uniform(-4.0, 4.0, (300, 3)), 0.3).state()
    state["points"] = forge(state["points"])
    with pytest.raises(InputError, match="not in the order of their voxels"):
        FeatureMap(100.0).restore(through_disk(state))


def test_neighbours_are_the_nearest_five_where_all_are_within_a_metre(rng: np.random.Generator) -> None:
    feature_map, queries = map_of(rng.uniform(-4.0, 4.0, (1000, 3))), rng.uniform(-5.0, 5.0, (800, 3))
    near = feature_map.neighbourhoods(queries, 0)
    distances, indices = cKDTree(feature_map.points).query(queries, 5)
    np.testing.assert_array_equal(near.index, np.flatnonzero(distances[:, 4] < 1.0))
    assert 100 < len(near.index) < 700
    nearest = feature_map.points[indices[near.index]]
    np.testing.assert_allclose(near.means, nearest.mean(axis=1), atol=1e-12)


def test_neighbours_are_of_the_latest_points() -> None:
    feature_map = map_of(np.linspace([1.0, 0.0, 0.0], [1.4, 0.0, 0.0], 5))
    assert len(feature_map.neighbourhoods(np.array([[1.2, 0.3, 0.0]]), 0).index) == 1
    feature_map.insert(np.linspace([1.0, 0.3, 0.0], [1.4, 0.3, 0.0], 5), ORIGIN, 0.01)
    np.testing.assert_allclose(feature_map.neighbourhoods(np.array([[1.2, 0.3, 0.0]]), 0).means, [[1.2, 0.3, 0.0]])


@pytest.mark.parametrize(("held", "asked"), [(0, 3), (4, 3), (30, 0), (0, 0)])
def test_too_few_points_have_no_neighbourhoods(rng: np.random.Generator, held: int, asked: int) -> None:
    feature_map = map_of(rng.uniform(-0.2, 0.2, (held, 3)), 0.001)
    for match in (match_lines, match_planes):
        matches = match(rng.uniform(-0.2, 0.2, (asked, 3)), feature_map)
        assert matches.points.shape == matches.normals.shape == (0, 3)
        assert matches.index.shape == matches.tilt.shape == (0,)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_principal_axes_are_the_eigenvectors(rng: np.random.Generator, which: int) -> None:
    points = rng.normal(size=(2000, 3)) @ rng.normal(size=(3, 3)) + [30.0, -20.0, 2.0]
    neighbours = rng.integers(0, 2000, (400, 5)).astype(np.int32)
    means, variances, axes = (np.empty((400, 3)) for _ in range(3))
    farthest_m = np.empty(400)
    write_principal_axes(points, neighbours, which, means, variances, axes, farthest_m)
    np.testing.assert_allclose(means, points[neighbours].mean(axis=1), rtol=1e-12)
    away = points[neighbours] - means[:, None]
    values, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", away, away) / 5.0)
    np.testing.assert_allclose(variances, values, atol=1e-10)
    np.testing.assert_allclose(np.abs(np.einsum("ki,ki->k", axes, vectors[:, :, which])), 1.0, atol=1e-8)
    np.testing.assert_allclose(farthest_m, np.abs(np.einsum("kni,ki->kn", away, axes)).max(axis=1), atol=1e-9)


def five(sizes: FloatArray) -> FloatArray:
    """Five points about (2, 1, 0) whose variances are the squared sizes (3,), along the axes."""
    pattern = np.array([[2, 1, 0, -1, -2], [1, -2, 0, 2, -1], [-1, 2, -2, 2, -1]], dtype=float).T
    pattern[:, 2] = [1, 1, -4, 1, 1]
    pattern[:, 0], pattern[:, 1] = [2, 1, 0, -1, -2], [1, -2, 0, 2, -1]
    return pattern / np.sqrt((pattern**2).mean(axis=0)) * sizes + [2.0, 1.0, 0.0]


QUERY = np.array([[2.05, 1.1, 0.03]])


@pytest.mark.parametrize(("ratio", "is_line"), [(2.9, False), (3.1, True)])
def test_a_line_is_three_times_as_spread_along_it_as_across(ratio: float, is_line: bool) -> None:
    edges = map_of(five(np.array([0.1 * np.sqrt(ratio), 0.1, 0.05])), 0.001)
    found = match_lines(QUERY, edges)
    assert len(found.index) == (2 if is_line else 0)
    if is_line:
        np.testing.assert_allclose(found.points, [[2.0, 1.0, 0.0]] * 2, atol=1e-12)
        np.testing.assert_allclose(found.normals @ [1.0, 0.0, 0.0], 0.0, atol=1e-9)
        np.testing.assert_allclose(found.normals @ found.normals.T, np.eye(2), atol=1e-9)
        np.testing.assert_allclose(found.tilt, np.sqrt(1.0 / (3.0 * ratio)))


@pytest.mark.parametrize(("farthest_m", "is_plane"), [(0.19, True), (0.21, False)])
def test_all_neighbours_of_a_plane_are_within_20_centimetres(farthest_m: float, is_plane: bool) -> None:
    size = farthest_m / 2.0  # the farthest of the pattern is at two standard deviations
    found = match_planes(QUERY, map_of(five(np.array([0.4, 0.3, size])), 0.001))
    assert len(found.index) == is_plane
    if is_plane:
        np.testing.assert_allclose(np.abs(found.normals), [[0.0, 0.0, 1.0]], atol=1e-9)
        np.testing.assert_allclose(found.tilt, size / 0.3 / np.sqrt(2.0))


@pytest.mark.parametrize(("share", "is_plane"), [(0.0, False), (0.14, False), (0.16, True)])
def test_collinear_neighbours_are_no_plane(share: float, is_plane: bool) -> None:
    """Points of one ring of a wall: 15 % of the spread along it is the least across."""
    assert len(match_planes(QUERY, map_of(five(np.array([0.3, 0.3 * share, 0.0])), 0.001)).index) == is_plane


# A hall of 12 x 9 x 5 m: its faces sampled away from their borders, and the lines where they meet, away from corners.
HALF = np.array([6.0, 4.5, 2.5])
BORDER_M = 0.7


def on_faces(rng: np.random.Generator, count: int, axes: tuple[int, ...] = (0, 1, 2)) -> FloatArray:
    points = rng.uniform(-1.0, 1.0, (count, 3)) * (HALF - BORDER_M)
    axis = np.array(axes)[np.arange(count) % len(axes)]
    points[np.arange(count), axis] = HALF[axis] * rng.choice([-1.0, 1.0], count)
    return points


def on_lines(rng: np.random.Generator, count: int, axes: tuple[int, ...] = (0, 1, 2)) -> FloatArray:
    points = HALF * rng.choice([-1.0, 1.0], (count, 3))
    axis = np.array(axes)[np.arange(count) % len(axes)]
    points[np.arange(count), axis] = rng.uniform(-1.0, 1.0, count) * (HALF - BORDER_M)[axis]
    return points


def hall(
    rng: np.random.Generator, faces: tuple[int, ...] = (0, 1, 2), lines: tuple[int, ...] = (0, 1, 2)
) -> FeatureMaps:
    return FeatureMaps(map_of(on_lines(rng, 3000, lines), 0.05), map_of(on_faces(rng, 12_000, faces), 0.15))


T_TRUE = exp([0.02, -0.03, 0.4, 1.0, -0.5, 0.2])
CLOSE = exp([0.01, -0.015, 0.03, 0.12, -0.08, 0.05])  # of the prediction to the truth
COVARIANCE = np.diag([1e-3, 2e-3, 3e-3, 0.02, 0.03, 0.04])


def seen(world: FloatArray) -> FloatArray:
    return transform_points(inverse(T_TRUE), world)


def located(
    edges: FloatArray, planes: FloatArray, maps: FeatureMaps, T_predicted: FloatArray | None = None
) -> LoamRegistration:
    found = register(edges, planes, T_TRUE @ CLOSE if T_predicted is None else T_predicted, COVARIANCE, maps, 0.2)
    assert found is not None
    return found


@pytest.mark.parametrize(("edges", "planes"), [(200, 600), (300, 0), (0, 600)])
def test_a_small_motion_is_found_exactly(rng: np.random.Generator, edges: int, planes: int) -> None:
    found = located(seen(on_lines(rng, edges)), seen(on_faces(rng, planes)), hall(rng))
    np.testing.assert_allclose(log(inverse(T_TRUE) @ found.T_world_lidar), 0.0, atol=1e-4)
    assert found.degeneracy.names == ()
    assert found.fit.status(TrackingConfig()) is Status.OK
    assert found.fit.residual_m == pytest.approx(0.0, abs=2e-3), "before the last step"


def test_the_fit_counts_features(rng: np.random.Generator) -> None:
    """An edge has two residuals, and is one feature; a hundred planar points are far from the map."""
    planes = np.concatenate([on_faces(rng, 200), rng.uniform(20.0, 30.0, (100, 3))])
    fit = located(seen(on_lines(rng, 300)), seen(planes), hall(rng), T_TRUE).fit
    assert fit.matched == 500
    assert fit.overlap == pytest.approx(500 / 600)


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_outliers_is_outweighed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    maps, edges, planes = hall(rng), on_lines(rng, 300), on_faces(rng, 900)
    for points in (edges, planes):
        points[::5] += rng.uniform(-1.0, 1.0, points[::5].shape)
    found = located(seen(edges), seen(planes), maps)
    error = log(inverse(T_TRUE) @ found.T_world_lidar)
    assert np.linalg.norm(error[:3]) < 0.005
    assert np.linalg.norm(error[3:]) < 0.02


def test_normal_equations_are_the_derivatives_of_the_squared_residuals(rng: np.random.Generator) -> None:
    """Gradient at the prediction, Hessian at the truth, where no residual bends."""
    problem_of = registration._Problem
    edges, every, maps = seen(on_lines(rng, 300)), seen(on_faces(rng, 600)), hall(rng)

    def cost(T: FloatArray, information: FloatArray) -> float:
        return float(0.5 * information @ problem_of(edges, planes, maps, 0.2, T)._residuals ** 2)

    for T in (T_TRUE @ exp(0.2 * log(CLOSE)), T_TRUE):
        planes = every[match_planes(transform_points(T, every), maps.planes).index]
        problem = problem_of(edges, planes, maps, 0.2, T)
        assert len(problem._first) == 300 + len(planes) > 880
        system = problem.linearise(T)
        assert system is not None
        information = problem._weights / (25.0 * 0.05**2)
        h, axes = 1e-5, np.eye(6)
        steps = [(cost(T @ exp(h * a), information) - cost(T @ exp(-h * a), information)) / (2.0 * h) for a in axes]
        scale = np.sqrt(np.diag(system.hessian))
        np.testing.assert_allclose(system.gradient / scale, np.array(steps) / scale, atol=2e-4)
    at_truth = [
        [(cost(T_TRUE @ exp(h * (a + b)), information) - cost(T_TRUE @ exp(h * (a - b)), information)) for b in axes]
        for a in axes
    ]
    np.testing.assert_allclose(
        system.hessian / np.outer(scale, scale), np.array(at_truth) / (2.0 * h**2) / np.outer(scale, scale), atol=1e-3
    )


def test_the_prediction_is_kept_along_a_corridor(rng: np.random.Generator) -> None:
    maps = hall(rng, faces=(1, 2), lines=(0,))
    T_predicted = T_TRUE @ CLOSE
    found = located(seen(on_lines(rng, 300, (0,))), seen(on_faces(rng, 900, (1, 2))), maps)
    assert found.degeneracy.names == ("x",)
    correction = log(inverse(T_predicted) @ found.T_world_lidar)
    np.testing.assert_allclose(found.degeneracy.rows @ correction, 0.0, atol=5e-5)
    assert np.linalg.norm(correction) > 0.05, "the others are corrected"
    error = T_TRUE[:3, :3].T @ (found.T_world_lidar - T_TRUE)[:3, 3], log(inverse(T_TRUE) @ found.T_world_lidar)[:3]
    np.testing.assert_allclose((T_TRUE[:3, :3] @ error[0])[1:], 0.0, atol=1e-4)
    np.testing.assert_allclose(error[1], 0.0, atol=1e-4)
    missed_m = (T_predicted - T_TRUE)[0, 3]
    assert (found.T_world_lidar - T_TRUE)[0, 3] == pytest.approx(missed_m, abs=0.01)


def test_the_covariance_along_a_corridor_is_that_of_the_prediction(rng: np.random.Generator) -> None:
    maps = hall(rng, faces=(1, 2), lines=(0,))
    lines, faces = on_lines(rng, 300, (0,)), on_faces(rng, 900, (1, 2))
    found = register(lines, faces, np.eye(4), COVARIANCE, maps, 0.2)
    assert found is not None
    assert found.degeneracy.names == ("x",)
    assert found.covariance[3, 3] == pytest.approx(COVARIANCE[3, 3], rel=1e-2)
    assert np.diag(found.covariance)[[4, 5]].max() < 0.01 * COVARIANCE[3, 3]


@pytest.mark.parametrize("without", ["line", "plane"])
def test_all_features_on_one_surface_constrain_only_what_it_does(rng: np.random.Generator, without: str) -> None:
    """One line leaves two directions open, one plane three; the prediction is kept there."""
    nothing = np.empty((0, 3))
    if without == "plane":
        along = np.column_stack([rng.uniform(-4.0, 4.0, 400), np.full(400, 3.0), np.full(400, 1.0)])
        maps, edges, planes, axes = FeatureMaps(map_of(along, 0.02), FeatureMap(9.0)), along[::2], nothing, [1, 2]
    else:
        flat = np.column_stack([rng.uniform(-4.0, 4.0, (4000, 2)), np.full(4000, -1.5)])
        maps, edges, planes, axes = FeatureMaps(FeatureMap(9.0), map_of(flat, 0.05)), nothing, flat[::9], [2]
    found = register(edges, planes, exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.05]), COVARIANCE, maps, 0.2)
    assert found is not None
    assert len(found.degeneracy) == 4 - len(axes)
    features = np.concatenate([edges, planes])
    moved = transform_points(found.T_world_lidar, features)
    np.testing.assert_allclose(moved[:, axes], features[:, axes], atol=2e-4)
    assert np.isfinite(found.covariance).all()


@pytest.mark.parametrize(("edges", "planes"), [(0, 0), (49, 0), (0, 49), (24, 25)])
def test_too_few_correspondences_make_no_pose(rng: np.random.Generator, edges: int, planes: int) -> None:
    """Fifty features with a correspondence."""
    maps = hall(rng)
    few, nearly = seen(on_lines(rng, edges)), seen(on_faces(rng, planes))
    assert register(few, nearly, T_TRUE, COVARIANCE, maps, 0.2) is None
    more = seen(on_lines(rng, edges + 1)), seen(on_faces(rng, planes + 1))
    assert (register(*more, T_TRUE, COVARIANCE, maps, 0.2) is None) == (edges + planes == 0)


def test_features_far_from_the_map_make_no_pose(rng: np.random.Generator) -> None:
    maps = hall(rng)
    assert register(on_lines(rng, 300), on_faces(rng, 300), exp([0, 0, 0, 50.0, 0, 0]), COVARIANCE, maps, 0.2) is None
    empty = FeatureMaps(FeatureMap(100.0), FeatureMap(100.0))
    assert register(on_lines(rng, 300), on_faces(rng, 300), T_TRUE, COVARIANCE, empty, 0.2) is None


def test_the_covariance_is_that_of_correlated_noise(rng: np.random.Generator) -> None:
    """Of independent noise of 5 cm it is 25 times that of the errors."""
    maps, errors, stated = hall(rng), [], []
    for _ in range(60):
        edges, planes = (seen(p + rng.normal(0.0, 0.05, p.shape)) for p in (on_lines(rng, 100), on_faces(rng, 300)))
        found = located(edges, planes, maps, T_TRUE)
        np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-9, atol=1e-15)
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
        errors.append(log(inverse(T_TRUE) @ found.T_world_lidar))
        stated.append(np.diag(found.covariance))
    ratio = np.mean(stated, axis=0) / np.mean(np.square(errors), axis=0)
    assert (ratio > 25.0 / 2.0).all()
    assert (ratio < 25.0 * 2.0).all()


def test_a_registration_is_the_same_each_time(rng: np.random.Generator) -> None:
    maps, edges, planes = hall(rng), seen(on_lines(rng, 300)), seen(on_faces(rng, 600))
    first, second = located(edges, planes, maps), located(edges, planes, replace(maps))
    np.testing.assert_array_equal(first.T_world_lidar, second.T_world_lidar)
    np.testing.assert_array_equal(first.covariance, second.covariance)
