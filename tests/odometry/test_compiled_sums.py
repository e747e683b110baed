"""The compiled sums over pairs against those of torch, on exact sweeps and on noisy ones."""

import numpy as np
import pytest
import torch

from lidarslam.core.geometry import exp
from odometry.alignment_config import AlignmentConfig
from odometry.compiled_sums import CompiledSums
from odometry.pair_sums import PairSums, TorchSums
from odometry.pairing import Movement
from odometry.sweeps import SweepImages, SweepPairs

CONFIG = AlignmentConfig()
TWIST = (0.1, -0.05, 0.6, 1.0, 0.3, 0.1)


def movement(size: int, seed: int) -> Movement:
    """Not quite the sweeps' own, and bent."""
    rng = np.random.default_rng(seed)
    velocity = np.array(TWIST) + rng.normal(0.0, 0.1, (size, 6))
    return Movement(exp(0.1 * velocity).reshape(-1, 4, 4), velocity, rng.normal(0.0, 0.2, (size, 6)))


def pairs_of(scene, size: int, rolling: bool) -> SweepPairs:
    """Sweeps on the ones before; points scattered, some pixels empty, some without a normal."""
    images = scene.sweeps(size + 1, TWIST, rolling=rolling)
    generator = torch.Generator().manual_seed(0)
    points = images.points * (1.0 + 0.002 * torch.randn(images.points.shape, generator=generator))
    kept = torch.rand(images.offsets.shape, generator=generator)
    points, normals = points * (kept > 0.05)[:, None], images.normals * (kept > 0.2)[:, None]
    images = SweepImages(points, normals, images.offsets, images.low, images.high)
    return SweepPairs(images.select(slice(1, None)), images.select(slice(0, size)), torch.full((size,), 0.1))


def both(sweeps: SweepPairs, config: AlignmentConfig) -> tuple[PairSums, PairSums]:
    return CompiledSums(sweeps, config), TorchSums(sweeps, config)


@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("scale_m", [0.5, 0.05])
def test_normal_equations_are_those_of_torch(box_room, size, rolling, scale_m):
    sweeps = pairs_of(box_room, size, rolling)
    (H, g), (H_torch, g_torch) = (s.normal_equations(movement(size, 1), scale_m) for s in both(sweeps, CONFIG))
    assert H.shape == (size, 12, 12)
    assert (np.trace(H[:, :6, :6], axis1=1, axis2=2) > 100.0).all()
    assert bool(H[:, 6:].any()) == rolling
    # A point on the border of two pixels may be held against either.
    np.testing.assert_allclose(H, H_torch, atol=2e-3 * np.abs(H_torch).max())
    np.testing.assert_allclose(g, g_torch, atol=2e-3 * np.abs(H_torch).max() * scale_m)


@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("options", [{}, {"column_step": 1, "fill_columns": 0}, {"fine_m": 0.01, "gate_m": 0.02}])
def test_tallies_are_those_of_torch(box_room, rolling, options):
    sweeps = pairs_of(box_room, 2, rolling)
    mine, torchs = (s.tally(movement(2, 2)) for s in both(sweeps, AlignmentConfig.model_validate(options)))
    assert (mine.count > 50).all()
    assert (mine.share_in_view > 0.5).all()
    assert (mine.share < mine.share_in_view).all()
    np.testing.assert_allclose(mine.count, torchs.count, atol=5, rtol=2e-3)
    for name in ("share_in_view", "share"):
        np.testing.assert_allclose(getattr(mine, name), getattr(torchs, name), atol=2e-3)
    for name in ("H", "in_view", "matched", "squares"):
        expected = getattr(torchs, name)
        np.testing.assert_allclose(getattr(mine, name), expected, atol=3e-3 * np.abs(expected).max(), rtol=5e-3)


def test_an_image_without_points_says_nothing(box_room):
    sweeps = pairs_of(box_room, 1, True)
    empty = SweepImages(*(torch.zeros_like(part) for part in vars(sweeps.current).values()))
    nothing = SweepPairs(SweepImages(empty.points, empty.normals, empty.offsets, sweeps.current.low,
                                     sweeps.current.high), sweeps.previous, sweeps.interval_s)  # fmt: skip
    sums = CompiledSums(nothing, CONFIG)
    H, g = sums.normal_equations(movement(1, 1), 0.5)
    assert not H.any()
    assert not g.any()
    assert sums.tally(movement(1, 1)).count == 0


def test_a_motion_that_is_none_holds_nothing(box_room):
    """NaN, as of equations without a solution, must not lead out of the image."""
    sums = CompiledSums(pairs_of(box_room, 1, True), CONFIG)
    H, _ = sums.normal_equations(Movement(np.full((1, 4, 4), np.nan), np.zeros((1, 6)), np.zeros((1, 6))), 0.5)
    assert not H.any()
