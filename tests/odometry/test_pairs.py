"""Pairs stay the truth's, however they are changed."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from lidarslam.core import geometry
from lidarslam.odometry.network.torch_geometry import log, rotate, transform_points
from lidarslam.odometry.training.pairs import Augmentation, PairBatch, Pairs, augmented, pair_of, reversed_pair, stack
from lidarslam.odometry.training.preparation import PreparedRecording

TWIST = (0.1, -0.1, 0.8, 2.0, 0.6, 0.2)
NONE = Augmentation(
    max_gap=1, reverse=0.0, roll=0.0, roll_deg=0.0, any_roll=0.0, mirror=0.0, scale=0.0, drop_beams=0.0,
    drop_points=0.0, hide_sector=0.0, range_noise_m=0.0, wet_ground=0.0, glass=0.0,
    normal_noise=0.0, drop_normals=0.0, fine=0.0,
)  # fmt: skip
WORN = {"drop_beams": 1.0, "drop_points": 0.5, "hide_sector": 1.0, "range_noise_m": 0.05}


def only(**options: Any) -> Augmentation:
    return NONE._replace(**options)


def exp(*xi: float) -> Tensor:
    return torch.from_numpy(geometry.exp(xi))


@pytest.fixture(scope="module")
def recording(small_room) -> PreparedRecording:
    return small_room.recording(4, TWIST)


def motion(steps: float = 1.0) -> Tensor:
    return exp(*(0.1 * steps * part for part in TWIST)).float()


def fit(batch: PairBatch, item: int) -> tuple[Tensor, Tensor]:
    """Of the current points moved onto the previous ones: distances to the nearest, ascending, and normals' cosines.

    Distances are in units of the previous scan's greatest range, which no augmentation changes but scaling.
    """
    previous, current = batch.surfaces[item].flatten(2).double().mT
    T = batch.T_prev_curr[item].double()
    distance, nearest = torch.cdist(transform_points(T, current[:, :3]), previous[:, :3]).min(dim=1)
    cosine = (rotate(T, current[:, 3:]) * previous[nearest, 3:]).sum(1)
    order = distance.argsort()
    return distance[order] / previous[:, :3].norm(dim=1).max(), cosine[order]


def test_a_pair_as_it_is(recording):
    pair = pair_of(recording, 1, 2, surfaces=False)
    torch.testing.assert_close(pair.T_prev_curr[0], motion())
    assert torch.equal(pair.scans[0], torch.cat([recording.points[1:3], recording.normals[1:3]], dim=1))
    assert (pair.valid.tolist(), pair.surfaces) == ([True], None)


@pytest.mark.parametrize(("previous", "current"), [(0, 1), (2, 3), (0, 3)])
def test_surfaces_are_those_seen_from_the_middle_of_the_sweep(recording, previous, current):
    """Laid on one another by the motion, walls are on walls."""
    pair = pair_of(recording, previous, current)
    torch.testing.assert_close(pair.T_prev_curr[0], motion(current - previous), rtol=0, atol=1e-6)
    poses = torch.stack([motion(previous), motion(current)])
    assert wall_distance(poses, pair.surfaces[0]) < 0.002
    assert wall_distance(poses, pair.scans[0]) > 0.05


def wall_distance(poses: Tensor, images: Tensor) -> float:
    """The greatest distance from the outer walls of points whose normals are along y, and that lie near those."""
    points = transform_points(poses, images[:, :3].flatten(2).mT)
    normals = rotate(poses, images[:, 3:].flatten(2).mT)
    outside = (normals[..., 1].abs() > 0.9) & (points[..., 1].abs() > 4.6)
    return float((points[outside][:, 1].abs() - 5.0).abs().max())


@pytest.mark.parametrize(("motion_number", "same"), [(1, [True, False]), (2, [True, True])])
def test_a_sweep_is_as_fast_as_the_motions_around_it(recording, motion_number, same):
    """Of the pair 0, 1 the second motion tells of scan 1 alone, the third of none."""
    T = recording.T_prev_curr.clone()
    T[motion_number] = exp(0.0, 0.0, 0.3, 0.5, 0.0, 0.0)
    changed, as_before = pair_of(replace(recording, T_prev_curr=T), 0, 1), pair_of(recording, 0, 1)
    assert [torch.equal(changed.surfaces[:, i], as_before.surfaces[:, i]) for i in range(2)] == same


def test_a_pair_is_valid_if_all_motions_between_are(recording):
    doubtful = replace(recording, valid=torch.tensor([True, False, True]))
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (0, 3)]
    assert [bool(pair_of(doubtful, *pair).valid) for pair in pairs] == [True, False, True, False, False]


@pytest.mark.parametrize("other", [{}, {"step": 8}, {"seed": 4}])
def test_pairs_depend_on_seed_and_step_alone(recording, other):
    def batch(seed: int = 3, step: int = 7) -> PairBatch:
        pairs = Pairs([recording], seed)
        pairs.batch(9, 2)
        return pairs.batch(step, 3)

    again, before = vars(batch(**other)), vars(Pairs([recording], 3).batch(7, 3))
    for name in ("scans", "surfaces", "birds", "T_prev_curr"):
        assert torch.equal(again[name], before[name]) == (not other)


AUGMENTATIONS: dict[str, dict[str, Any]] = {
    "turned_alike": {},
    "roll": {"roll": 1.0, "roll_deg": 20.0},
    "any_roll": {"roll": 1.0, "any_roll": 1.0},
    "mirror": {"mirror": 1.0},
    "scale": {"scale": 0.5},
    "reverse": {},
    "all": {"roll": 0.8, "roll_deg": 12.0, "any_roll": 0.2, "mirror": 0.5, "scale": 0.3},
}


@pytest.mark.parametrize("name", AUGMENTATIONS)
@pytest.mark.parametrize("gap", [1, 2])
def test_the_motion_follows_what_is_done_to_the_scans(recording, name, gap):
    """Moved by it the current points lie on the previous ones where they lay before."""
    pair = pair_of(recording, 0, gap)
    if name == "reverse":
        pair = reversed_pair(pair)
        torch.testing.assert_close(pair.T_prev_curr[0], motion(-gap), rtol=0, atol=1e-6)
    batch = augmented(stack([pair] * 3), only(**AUGMENTATIONS[name]), torch.Generator().manual_seed(1))
    expected = fit(pair, 0)
    for item in range(3):
        distance, cosine = fit(batch, item)
        torch.testing.assert_close(distance, expected[0], rtol=0, atol=1e-6)
        assert (cosine - expected[1]).abs().median() < 1e-6
        torch.testing.assert_close(cosine.mean(), expected[1].mean(), rtol=0, atol=1e-3)
        wrong = replace(batch, T_prev_curr=exp(0.0, 0.0, 1e-3, 0.0, 0.0, 0.0).float() @ batch.T_prev_curr)
        assert (fit(wrong, item)[0] - expected[0]).abs().max() > 1e-5


@pytest.mark.parametrize("change", ["mirror", "reverse"])
def test_half_of_the_pairs_turn_the_other_way_round(recording, change):
    batch = Pairs([recording], 0, surfaces=False, augmentation=only(**{change: 0.5})).batch(0, 40)
    yaw = log(batch.T_prev_curr)[:, 2]
    torch.testing.assert_close(yaw.abs(), yaw[0].abs().expand(40), rtol=0, atol=2e-3)
    assert 10 < int((yaw < 0.0).sum()) < 30


@pytest.mark.parametrize("name", WORN)
def test_worn_scans_gain_nothing_and_surfaces_are_spared(recording, name):
    pair = pair_of(recording, 0, 1)
    holes = torch.rand(16, 96, generator=torch.Generator().manual_seed(0)) < 0.2
    several = stack([pair.changed(lambda images: images * ~holes, pair.T_prev_curr)] * 8)
    worn = augmented(several, only(**{name: WORN[name]}), torch.Generator().manual_seed(2))
    there, left = (images[:, :, :3].square().sum(2) > 0.0 for images in (worn.surfaces, worn.scans))
    assert (left & ~there).sum() == 0
    assert (worn.scans[:, :, 3:].square().sum(2) > 0.5).le(left).all()
    assert [bool((there & ~left)[:, i].any()) for i in range(2)] == [name != "range_noise_m"] * 2


def test_noise_is_along_the_rays_and_of_the_size_asked_for(recording):
    several = stack([pair_of(recording, 0, 1, surfaces=False)] * 40)
    quiet, noisy = (augmented(several, only(range_noise_m=m), torch.Generator().manual_seed(5)) for m in (0.0, 0.05))
    before, after = (b.scans[:, 0, :3].double() for b in (quiet, noisy))
    ranges = before.norm(dim=1)
    torch.testing.assert_close(torch.nn.functional.cosine_similarity(before, after), torch.ones_like(ranges))
    spread = (after.norm(dim=1) - ranges)[ranges > 1.0].view(-1).std()
    # A standard deviation that is drawn evenly up to s makes s / sqrt(3) in all.
    assert float(spread) == pytest.approx(0.05 / math.sqrt(3.0), rel=0.2)


def test_worn_normals_are_unit_tilted_and_fewer(recording):
    several = stack([pair_of(recording, 0, 1, surfaces=False)] * 16)
    worn = augmented(several, only(heading=0.0, normal_noise=0.3, drop_normals=0.5), torch.Generator().manual_seed(3))
    torch.testing.assert_close(worn.scans[:, :, :3], several.scans[:, :, :3])
    before, after = several.scans[:, 0, 3:], worn.scans[:, 0, 3:]
    lengths = after.norm(dim=1)
    kept = lengths > 0.0
    torch.testing.assert_close(lengths[kept], torch.ones_like(lengths[kept]))
    assert 0.5 < float(kept.sum() / (before.norm(dim=1) > 0.0).sum()) < 1.0
    assert 0.8 < float((before * after).sum(1)[kept].mean()) < 1.0


@pytest.mark.parametrize(("along_m", "scale"), [(8.0, 2.0), (9.0, 1.0)])
def test_scenes_are_enlarged_if_the_translation_stays_within_the_grid(small_room, along_m, scale):
    recording = small_room.recording(2, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    T = torch.eye(4).repeat(1, 1, 1)
    T[:, 0, 3] = along_m
    pairs = Pairs([replace(recording, T_prev_curr=T)], seed=1, surfaces=False, augmentation=only(fine=1.0, heading=0.0))
    batch = pairs.batch(0, 4)
    assert batch.scale.tolist() == [scale] * 4
