"""Pairs stay the truth's, however they are changed."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from lidarslam.odometry.network.torch_geometry import log, rotate, skew, transform_points
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


def exp(xi: Tensor) -> Tensor:
    """SE(3) exponential (..., 4, 4) of tangents (..., 6), rotation first."""
    top = torch.cat([skew(xi[..., :3]), xi[..., 3:, None]], dim=-1)
    return torch.linalg.matrix_exp(torch.nn.functional.pad(top, (0, 0, 0, 1)))


def rotation_angle(T: Tensor) -> Tensor:
    return log(T)[..., :3].norm(dim=-1)


@pytest.fixture(scope="module")
def recording(small_room) -> PreparedRecording:
    return small_room.recording(4, TWIST)


def motion(steps: float = 1.0) -> Tensor:
    return exp(0.1 * steps * torch.tensor(TWIST, dtype=torch.float64)).float()


def same(a: PairBatch, b: PairBatch) -> bool:
    return all(
        x is y if x is None or y is None else torch.equal(x, y)
        for x, y in zip(vars(a).values(), vars(b).values(), strict=True)
    )


def fit(batch: PairBatch, item: int) -> tuple[Tensor, Tensor]:
    """Of the current points moved onto the previous ones: distances to the nearest, ascending, and normals' cosines.

    Distances are in units of the previous scan's greatest range, which no augmentation changes but scaling.
    """
    assert batch.previous_surfaces is not None
    assert batch.current_surfaces is not None
    previous, current = (s[item].flatten(1).double().T for s in (batch.previous_surfaces, batch.current_surfaces))
    T = batch.T_prev_curr[item].double()
    distance, nearest = torch.cdist(transform_points(T, current[:, :3]), previous[:, :3]).min(dim=1)
    cosine = (rotate(T, current[:, 3:]) * previous[nearest, 3:]).sum(1)
    order = distance.argsort()
    return distance[order] / previous[:, :3].norm(dim=1).max(), cosine[order]


def test_a_pair_as_it_is(recording):
    pair = pair_of(recording, 1, 2)
    torch.testing.assert_close(pair.T_prev_curr[0], motion())
    for images, number in ((pair.previous, 1), (pair.current, 2)):
        assert torch.equal(images[0, :3], recording.points[number])
        assert torch.equal(images[0, 3:], recording.normals[number])
    assert pair.valid.tolist() == [True]
    plain = pair_of(recording, 1, 2, surfaces=False)
    assert plain.previous_surfaces is None
    assert plain.current_surfaces is None


@pytest.mark.parametrize("gap", [1, 2, 3])
def test_motions_add_up_over_gaps(recording, gap):
    torch.testing.assert_close(pair_of(recording, 0, gap).T_prev_curr[0], motion(gap), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("previous", "current"), [(0, 1), (2, 3), (0, 3)])
def test_surfaces_are_those_seen_from_the_middle_of_the_sweep(small_room, recording, previous, current):
    """Laid on one another by the motion, walls are on walls."""
    pair = pair_of(recording, previous, current)
    surfaces = torch.stack([s[0] for s in (pair.previous_surfaces, pair.current_surfaces)])
    raw = torch.stack([pair.previous[0], pair.current[0]])
    poses = torch.stack([motion(previous), motion(current)])
    assert wall_distance(poses, surfaces) < 0.002
    assert wall_distance(poses, raw) > 0.05


def wall_distance(poses: Tensor, images: Tensor) -> float:
    """The greatest distance from the outer walls of points whose normals are along y, and that lie near those."""
    points = transform_points(poses, images[:, :3].flatten(2).mT)
    normals = rotate(poses, images[:, 3:].flatten(2).mT)
    outside = (normals[..., 1].abs() > 0.9) & (points[..., 1].abs() > 4.6)
    return float((points[outside][:, 1].abs() - 5.0).abs().max())


@pytest.mark.parametrize(("motion_number", "previous_is_same", "current_is_same"), [(1, True, False), (2, True, True)])
def test_a_sweep_is_as_fast_as_the_motions_around_it(recording, motion_number, previous_is_same, current_is_same):
    """Of the pair 0, 1 the second motion tells of scan 1 alone, the third of none."""
    T = recording.T_prev_curr.clone()
    T[motion_number] = exp(torch.tensor([0.0, 0.0, 0.3, 0.5, 0.0, 0.0]))
    changed, same_as = pair_of(replace(recording, T_prev_curr=T), 0, 1), pair_of(recording, 0, 1)
    assert torch.equal(changed.previous_surfaces, same_as.previous_surfaces) == previous_is_same
    assert torch.equal(changed.current_surfaces, same_as.current_surfaces) == current_is_same


def test_a_pair_is_valid_if_all_motions_between_are(recording):
    doubtful = replace(recording, valid=torch.tensor([True, False, True]))
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (0, 3)]
    assert [bool(pair_of(doubtful, *pair).valid) for pair in pairs] == [True, False, True, False, False]


def test_the_same_step_gives_the_same_pairs(recording):
    a, b = (Pairs([recording], seed=3) for _ in range(2))
    a.batch(8, 2)
    assert same(a.batch(7, 3), b.batch(7, 3))


@pytest.mark.parametrize("other", [{"step": 8}, {"process": 1}, {"seed": 4}])
def test_other_steps_processes_and_seeds_give_others(recording, other):
    def batch(seed: int = 3, step: int = 7, process: int = 0) -> PairBatch:
        return Pairs([recording], seed).batch(step, 3, process)

    assert not torch.equal(batch(**other).T_prev_curr, batch().T_prev_curr)
    assert not torch.equal(batch(**other).previous, batch().previous)


AUGMENTATIONS: dict[str, dict[str, Any]] = {
    "turned_alike": {},
    "roll": {"roll": 1.0, "roll_deg": 20.0},
    "any_roll": {"roll": 1.0, "any_roll": 1.0},
    "mirror": {"mirror": 1.0},
    "scale": {"scale": 0.5},
    "reverse": {"reverse": 1.0},
    "all": {"roll": 0.8, "roll_deg": 12.0, "any_roll": 0.2, "mirror": 0.5, "scale": 0.3},
}


@pytest.mark.parametrize("name", AUGMENTATIONS)
@pytest.mark.parametrize("gap", [1, 2])
def test_the_motion_follows_what_is_done_to_the_scans(recording, name, gap):
    """Moved by it the current points lie on the previous ones where they lay before."""
    as_it_is = pair_of(recording, 0, gap)
    if name == "reverse":
        two = pair_of(recording, 0, 1)
        batch = Pairs([_first_two(recording)], 0, augmentation=only(reverse=1.0)).batch(0, 3)
        expected = fit(reversed_pair(two), 0)
    else:
        several = stack([as_it_is] * 3)
        generator = torch.Generator().manual_seed(1)
        batch = augmented(several, only(**AUGMENTATIONS[name]), generator)
        expected = fit(as_it_is, 0)
    for item in range(3):
        distance, cosine = fit(batch, item)
        torch.testing.assert_close(distance, expected[0], rtol=0, atol=1e-6)
        assert (cosine - expected[1]).abs().median() < 1e-6
        torch.testing.assert_close(cosine.mean(), expected[1].mean(), rtol=0, atol=1e-3)
        off = exp(torch.tensor([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0]))
        wrong = replace(batch, T_prev_curr=off @ batch.T_prev_curr)
        assert (fit(wrong, item)[0] - expected[0]).abs().max() > 1e-5


def _first_two(recording: PreparedRecording) -> PreparedRecording:
    motions = ("interval_s", "T_prev_curr", "valid")
    return PreparedRecording(**{name: part[: 1 if name in motions else 2] for name, part in vars(recording).items()})


def test_mirrors_turn_the_other_way_round(recording):
    batch = Pairs([recording], 0, surfaces=False, augmentation=only(mirror=0.5)).batch(0, 40)
    yaw = log(batch.T_prev_curr)[:, 2]
    torch.testing.assert_close(yaw.abs(), yaw[0].abs().expand(40), rtol=0, atol=1e-5)
    assert 10 < int((yaw < 0.0).sum()) < 30


def _with_holes(recording: PreparedRecording) -> PairBatch:
    pair = pair_of(recording, 0, 1)
    holes = torch.rand(1, 1, 16, 96, generator=torch.Generator().manual_seed(0)) < 0.2
    return pair.changed(lambda images: images * ~holes, lambda images: images * ~holes, pair.T_prev_curr)


@pytest.mark.parametrize("name", WORN)
def test_worn_scans_gain_nothing_and_surfaces_are_spared(recording, name):
    whole = _with_holes(recording)
    several = stack([whole] * 8)
    worn = augmented(several, only(**{name: WORN[name]}), torch.Generator().manual_seed(2))
    for before, after in ((worn.previous_surfaces, worn.previous), (worn.current_surfaces, worn.current)):
        there, left = (images[:, :3].square().sum(1) > 0.0 for images in (before, after))
        assert (left & ~there).sum() == 0
        assert (after[:, 3:].square().sum(1) > 0.5).le(left).all()
        if name == "range_noise_m":
            assert torch.equal(left, there)
        else:
            assert (there & ~left).any()
    torch.testing.assert_close(rotation_angle(worn.T_prev_curr), rotation_angle(several.T_prev_curr))


def test_noise_is_along_the_rays_and_of_the_size_asked_for(recording):
    pair = pair_of(recording, 0, 1, surfaces=False)
    several = stack([pair] * 40)
    quiet, noisy = (
        augmented(several, only(range_noise_m=sigma), torch.Generator().manual_seed(5)) for sigma in (0.0, 0.05)
    )
    before, after = (b.previous[:, :3].double() for b in (quiet, noisy))
    ranges = before.norm(dim=1)
    torch.testing.assert_close(torch.nn.functional.cosine_similarity(before, after), torch.ones_like(ranges))
    spread = (after.norm(dim=1) - ranges)[ranges > 1.0].view(-1).std()
    # A standard deviation that is drawn evenly up to s makes s / sqrt(3) in all.
    assert float(spread) == pytest.approx(0.05 / math.sqrt(3.0), rel=0.2)


def test_worn_normals_are_unit_tilted_and_fewer(recording):
    several = stack([pair_of(recording, 0, 1, surfaces=False)] * 16)
    worn = augmented(several, only(heading=0.0, normal_noise=0.3, drop_normals=0.5), torch.Generator().manual_seed(3))
    torch.testing.assert_close(worn.previous[:, :3], several.previous[:, :3])
    before, after = several.previous[:, 3:], worn.previous[:, 3:]
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
    assert batch.scale is not None
    assert batch.scale.tolist() == [scale] * 4
