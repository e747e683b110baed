"""The compiled sums over correspondences against plain NumPy, on noisy sweeps; Gauss-Newton steps against LAPACK."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.alignment.point_to_plane import FINE_M, PairMotion, PointToPlane
from lidarslam.odometry.alignment.steps import take_step, write_velocities
from lidarslam.odometry.alignment.sweep_motion import SweepPair
from lidarslam.odometry.images.projection import ImageGrid

STEP, FILL, GATE_M, GATE_PER_M, LEAST_COSINE = 2, 4, 0.2, 0.04, 0.8
TWIST = (0.1, -0.05, 0.6, 1.0, 0.3, 0.1)


def motion(seed: int) -> PairMotion:
    """Not quite the sweeps' own, and bent."""
    rng = np.random.default_rng(seed)
    velocity = np.array(TWIST) + rng.normal(0.0, 0.1, 6)
    change = rng.normal(0.0, 0.2, 6)
    return PairMotion(exp(0.1 * velocity), velocity - change, velocity + change)


def noisy_pair(scene, rolling: bool) -> SweepPair:
    """A sweep on the one before; points scattered, some pixels empty, some without a normal."""
    rng = np.random.default_rng(0)
    worn = []
    for sweep in scene.sweeps(2, TWIST, rolling=rolling):
        points = (sweep.points * (1.0 + 0.002 * rng.normal(size=sweep.points.shape))).astype(np.float32)
        kept = rng.uniform(size=sweep.offsets.shape)
        worn.append(replace(sweep, points=points * (kept > 0.05), normals=sweep.normals * (kept > 0.2)))
    return SweepPair(worn[1], worn[0], 0.1)


class SlowSums:
    """The same point by point, without blocks or tables."""

    def __init__(self, sweeps: SweepPair) -> None:
        self.target = sweeps.previous
        height, width = self.target.offsets.shape
        self.grid = ImageGrid(height, width, self.target.low, self.target.high)
        images = (sweeps.current.points, sweeps.current.normals, sweeps.current.offsets[None])
        points, normals, offsets = (np.moveaxis(one[..., ::STEP], 0, -1).astype(float) for one in images)
        there = normals.any(axis=-1)
        self.points = list(zip(points[there], normals[there], offsets[there, 0], strict=True))
        self.source = np.array([[self.filled(i, j) for j in range(width)] for i in range(height)])

    def filled(self, i: int, j: int) -> int:
        """The column of the nearest pixel in the row that has a normal."""
        width = self.target.offsets.shape[1]
        for step in range(2 * FILL + 1):
            distance = (step + 1) // 2 * (1 if step % 2 == 1 else -1)
            if self.target.normals[:, i, (j - distance) % width].any():
                return (j - distance) % width
        return j

    def pixel(self, point: FloatArray) -> tuple[tuple[int, int], bool]:
        x, y, z = point
        row = (np.arctan2(z, np.hypot(x, y)) - self.grid.elevation_low) * self.grid.rows_per_radian
        column = np.arctan2(y, x) % (2.0 * np.pi) * (self.grid.columns / (2.0 * np.pi)) % self.grid.columns
        whole = int(np.floor(row + 0.5))
        i = min(max(whole, 0), self.grid.rows - 1)
        return (i, int(self.source[i, int(column)])), 0 <= whole < self.grid.rows

    def pairs(self, motion: PairMotion, scale_m: float):
        """Jacobian (12,), residual, turned normal, and whether the point is in view and kept, of each point."""
        T, early, late = motion
        for p, n, t in self.points:
            moved = T[:3, :3] @ seen_at(p, t, late) + T[:3, 3]
            pixel, _ = self.pixel(moved)
            time = float(self.target.offsets[pixel])
            seen = seen_at(moved, -time, early)
            (i, j), inside = self.pixel(seen)
            plane, difference = self.target.normals[:, i, j], seen - self.target.points[:, i, j]
            distance = np.linalg.norm(seen)
            across = max(abs(seen @ plane), 0.2 * distance)
            gate = GATE_M + GATE_PER_M * distance**2 / across + scale_m
            turned = T[:3, :3] @ n
            kept = inside and np.linalg.norm(difference) < gate and turned @ plane > LEAST_COSINE
            J = np.concatenate([np.cross(seen, plane), plane])
            yield np.concatenate([J, (t + time) * J]), difference @ plane, turned, inside, kept


def seen_at(point: FloatArray, seconds: float, velocity: FloatArray) -> FloatArray:
    T = exp(seconds * velocity)
    return T[:3, :3] @ point + T[:3, 3]


@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("scale_m", [0.5, 0.05])
def test_normal_equations_are_those_of_the_slow_sums(box_room, rolling, scale_m):
    sweeps = noisy_pair(box_room, rolling)
    H, g = PointToPlane(sweeps, STEP).normal_equations(motion(1), scale_m)
    expected_H, expected_g = np.zeros((12, 12)), np.zeros(12)
    for J, residual, _, _, kept in SlowSums(sweeps).pairs(motion(1), scale_m):
        weight = kept / (1.0 + (residual / scale_m) ** 2) ** 2
        expected_H += weight * np.outer(J, J)
        expected_g += weight * residual * J
    assert np.trace(H[:6, :6]) > 100.0
    assert bool(H[6:].any()) == rolling
    # A point on the border of two pixels may be held against either.
    np.testing.assert_allclose(H, expected_H, atol=3e-3 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=3e-3 * np.abs(expected_H).max() * scale_m)


@pytest.mark.parametrize("rolling", [False, True])
def test_fits_are_those_of_the_slow_sums(box_room, rolling):
    sweeps = noisy_pair(box_room, rolling)
    found = PointToPlane(sweeps, STEP).fit(motion(2))
    slow = list(SlowSums(sweeps).pairs(motion(2), FINE_M))
    seen = [turned for _, _, turned, inside, _ in slow if inside]
    good = [(J, turned) for J, residual, turned, _, kept in slow if kept and abs(residual) < 2.0 * FINE_M]
    assert found.inliers > 50
    assert found.inliers == pytest.approx(len(good), abs=5, rel=3e-3)
    assert found.share_in_view == pytest.approx(len(seen) / len(slow), abs=2e-3)
    jacobians, inliers = zip(*good, strict=True)
    for matrix, vectors in ((found.H, jacobians), (found.in_view, seen), (found.inlier, inliers)):
        expected = np.array(vectors).T @ np.array(vectors)
        np.testing.assert_allclose(matrix, expected, atol=4e-3 * np.abs(expected).max())


def positive(rng: np.random.Generator, size: int, weakest: float = 1.0) -> np.ndarray:
    axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return np.ascontiguousarray(axes @ np.diag(np.geomspace(weakest, 1e3, size)) @ axes.T)


@pytest.mark.parametrize("weakest", [1.0, 1e-6])
@pytest.mark.parametrize("size", [0.01, 30.0])
def test_a_step_solves_the_normal_equations_with_both_priors(weakest, size):
    rng = np.random.default_rng(0)
    H, g = positive(rng, 12, weakest), size * rng.normal(size=12)
    information, expected = positive(rng, 6), positive(rng, 6)
    T, T_prior, innovation = exp(0.3 * rng.normal(size=6)), exp(0.3 * rng.normal(size=6)), size * rng.normal(size=6)
    whole = H + 1e-3 * np.eye(12)
    whole[:6, :6] += information
    whole[6:, 6:] += expected
    away = log(T @ inverse(T_prior))
    delta = -np.linalg.solve(whole, g + np.concatenate([information @ away, expected @ innovation]))
    step = delta[:6] * min(1.0, 0.3 / np.abs(delta[:6]).max())
    moved, changed = T.copy(), innovation.copy()
    largest = take_step(moved, changed, H, g, inverse(T_prior), information, expected)
    np.testing.assert_allclose(moved, exp(step) @ T, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(changed, innovation + delta[6:], rtol=1e-8, atol=1e-10)
    assert largest == pytest.approx(np.abs(step).max(), rel=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 2.0, 3.14])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8)])
def test_velocities_are_the_logarithm_and_a_change(angle, axis):
    xi = np.array([*(angle * np.array(axis)), 1.0, -2.0, 0.5])
    innovation, last = np.arange(6.0), np.ones(6)
    early, late = np.empty(6), np.empty(6)
    write_velocities(exp(xi), innovation, 0.1, 0.5, last, early, late)
    change = innovation + 0.5 * (10.0 * xi - last)
    np.testing.assert_allclose(early, 10.0 * xi - change, atol=1e-7)
    np.testing.assert_allclose(late, 10.0 * xi + change, atol=1e-7)
