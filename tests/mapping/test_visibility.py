"""What moved is seen through, and what stands is not: in a room whose every surface is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.mapping.global_map.moved_points import PlacedViews, Views, seen_through

VOXEL_M = 0.1
ROWS, COLUMNS = 16, 360
GRID = np.array([-math.radians(15.0), 15.0 / math.radians(30.0), 0.5])

# Lowest and highest corners.
PERSON = np.array([[1.0, 1.0, 0.1], [1.5, 1.5, 1.8]])
FURNITURE = {
    "table": np.array([[2.0, -2.0, 0.72], [3.6, -1.2, 0.76]]),
    "pole": np.array([[-1.5, 1.5, 0.0], [-1.44, 1.56, 2.5]]),
    "door": np.array([[-2.0, -3.0, 0.0], [-1.95, -2.1, 2.1]]),
}
ROOM = np.array([[-20.0, -3.0, 0.0], [5.0, 3.0, 2.6]])  # long: its floor is seen at grazing angles
NAMES = ("room", *FURNITURE, "person")


def look(T_world_lidar: FloatArray, with_person: bool, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.intp]]:
    """A scan of 16 lasers with 2 cm of noise: points (N, 3) in its frame, and which of `NAMES` each is of."""
    elevations, azimuths = np.deg2rad(np.meshgrid(np.linspace(-15.0, 15.0, 16), np.arange(0.0, 360.0, 0.5)))
    level = np.cos(elevations)
    rays = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)], axis=-1).reshape(-1, 3)
    directions, origin = rays @ T_world_lidar[:3, :3].T, T_world_lidar[:3, 3]
    boxes = [*FURNITURE.values(), *([PERSON] if with_person else [])]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = ((ROOM[:, None] - origin) / directions).max(axis=0)
        ranges = [np.where(np.isnan(ends), np.inf, ends).min(axis=1)]
        for box in boxes:
            sides = (box[:, None] - origin) / directions
            enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
            ranges.append(np.where((enter > 0.0) & (enter < leave), enter, np.inf))
    of = np.argmin(ranges, axis=0)
    nearest = np.min(ranges, axis=0) + 0.02 * rng.normal(size=len(rays))
    return rays * nearest[:, None], of


def walk(count: int) -> FloatArray:
    """Poses (count, 4, 4) of a sensor that goes through the room and turns."""
    phase = np.linspace(0.0, 1.0, count)[:, None]
    poses = exp(phase * [0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    poses[:, :3, 3] = [-6.0, -0.5, 1.1] + phase * [5.5, 1.0, 0.0]
    return poses


def removed(rng: np.random.Generator, person_until: int, count: int = 30, noise_m: float = 0.01) -> dict[str, float]:
    """The share of each thing's points that is left out, the person there in the first scans only."""
    poses, views = walk(count), Views(every=1)
    points, of = [], []
    for number, pose in enumerate(poses):
        seen, things = look(pose, number < person_until, rng)
        views.add(seen, number)
        points.append(transform_points(pose, seen))
        of.append(things)
    found = poses @ exp(noise_m * rng.normal(size=(count, 6)) * np.repeat([0.1, 1.0], 3))
    moved = seen_through(np.concatenate(points), views.placed(found), VOXEL_M)
    return {name: float(moved[np.concatenate(of) == number].mean()) for number, name in enumerate(NAMES)}


def test_who_was_there_for_a_while_is_left_out_and_what_stands_is_kept(rng):
    shares = removed(rng, person_until=4)
    assert shares.pop("person") > 0.8
    assert shares.pop("room") < 0.001
    assert max(shares.values()) < 0.02, shares


def test_who_stays_is_kept(rng):
    shares = removed(rng, person_until=30)
    assert max(shares.values()) < 0.02, shares


def test_where_half_of_the_views_see_somebody_nothing_is_left_out(rng):
    assert removed(rng, person_until=15)["person"] < 0.1


def wall(range_m: float) -> NDArray[np.float32]:
    return np.full((ROWS, COLUMNS), range_m, dtype=np.float32)


def placed(images: list[NDArray[np.float32]], poses: FloatArray | None = None, has_gaps: bool = False) -> PlacedViews:
    count = len(images)
    return PlacedViews(
        np.array(images, dtype=np.float32).reshape(-1, ROWS, COLUMNS),
        np.tile([*GRID[:2], 0.3] if has_gaps else GRID, (count, 1)),
        np.tile(np.eye(4), (count, 1, 1)) if poses is None else poses,
    )


def at(azimuth_deg: float, range_m: float = 5.0, elevation_deg: float = 1.0) -> FloatArray:
    a, e = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    return range_m * np.array([[np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]])


@pytest.mark.parametrize("azimuth_deg", [0.1, 180.1, -1e-15])
@pytest.mark.parametrize(
    ("through", "support", "expected", "with_gaps"),
    [
        (2, 0, False, False), (3, 0, True, True), (3, 1, True, True), (3, 2, True, False), (3, 3, True, False),
        (3, 4, False, False), (4, 2, True, True), (5, 3, True, False), (7, 6, True, False), (6, 7, False, False),
    ],
)  # fmt: skip
def test_views_are_counted_in_whatever_order(azimuth_deg, through, support, expected, with_gaps):
    """With gaps between the beams it takes two that see through for one that does not."""
    images = [wall(10.0)] * through + [wall(5.1)] * support
    at_centre = at(azimuth_deg, elevation_deg=float(np.rad2deg(GRID[0] + 8 / GRID[1])))
    for order in (images, images[::-1]):
        assert seen_through(at_centre, placed(order), VOXEL_M).tolist() == [expected]
        assert seen_through(at_centre, placed(order, has_gaps=True), VOXEL_M).tolist() == [with_gaps]


def test_between_lasers_that_are_far_apart_nothing_is_seen():
    """A board that lies there is met by one in a few scans only; where rows are full of beams there is no between."""
    lasers, all_over = Views(every=1), Views(every=1)
    elevations = {lasers: np.arange(-15.0, 15.1, 2.0), all_over: np.arange(-15.0, 15.1, 0.25)}
    for number in range(3):
        for views, found in elevations.items():
            views.add(np.concatenate([at(a + 0.5, 9.0, e) for a in range(40) for e in found]), number)
    for views, above_deg, expected in (
        (lasers, 0.5, True), (lasers, 0.7, False), (lasers, -0.7, False), (all_over, 0.7, True), (all_over, -0.7, True),
    ):  # fmt: skip
        seen = views.placed(np.tile(np.eye(4), (3, 1, 1)))
        assert seen_through(at(10.0, 5.0, 1.0 + above_deg), seen, VOXEL_M).tolist() == [expected]


def test_far_away_and_outside_the_rows_nothing_is_seen():
    images = [wall(60.0)] * 9
    reach_m = 3.0 * 0.1 * 360.0 / (2.0 * np.pi)
    for point, expected in (
        (at(10.0, reach_m - 0.1), True), (at(10.0, reach_m + 0.1), False),
        (at(10.0, 5.0, 15.5), True), (at(10.0, 5.0, 16.5), False), (at(10.0, 5.0, -16.5), False),
    ):  # fmt: skip
        assert seen_through(point, placed(images), VOXEL_M).tolist() == [expected]
    assert seen_through(at(10.0, 4.9), placed(images), 0.01).all()  # near, though pixels are wider than voxels
    assert not seen_through(np.full((1, 3), np.nan), placed(images), VOXEL_M).any()
    assert not seen_through(at(10.0), placed([]), VOXEL_M).any()
    assert seen_through(np.empty((0, 3)), placed(images), VOXEL_M).shape == (0,)


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 12))
def test_the_verdict_is_that_of_all_views(seed, count):
    """Beside a count of every view's testimony, written down without a thought of speed."""
    rng = np.random.default_rng(seed)
    images = [rng.choice([0.0, 3.0, 5.0, 9.0, 9.0, 9.0, 9.0, 9.0], (ROWS, COLUMNS)) for _ in range(count)]
    smooth = [np.repeat(np.repeat(image[::4, ::4], 4, axis=0), 4, axis=1).astype(np.float32) for image in images]
    poses = exp(rng.normal(size=(count, 6)) * 0.2)
    points = rng.normal(size=(200, 3)) * [4.0, 4.0, 0.5]
    expected = np.zeros(200, dtype=bool)
    for number, point in enumerate(points):
        says = [_says(T[:3, :3] @ point + T[:3, 3], image) for T, image in zip(inverse(poses), smooth, strict=True)]
        expected[number] = says.count(1) >= max(3, says.count(-1))
    np.testing.assert_array_equal(seen_through(points, placed(smooth, poses), VOXEL_M), expected)


def _says(point: FloatArray, image: NDArray[np.float32]) -> int:
    distance = float(np.linalg.norm(point))
    row = math.floor((math.asin(point[2] / distance) - GRID[0]) * GRID[1] + 0.5)
    column = math.floor(math.degrees(math.atan2(point[1], point[0])) % 360.0) % 360
    if distance > 3.0 * VOXEL_M * 180.0 / math.pi or not 0 <= row < ROWS:
        return 0
    around = image[max(row - 1, 0) : row + 2].take([column - 1, column, column + 1], axis=1, mode="wrap")
    seen = around[around > 0.0] - distance
    margin = 0.1 + 0.01 * distance + VOXEL_M
    if (np.abs(seen) <= margin).any():
        return -1
    return int(image[row, column] > 0.0 and len(seen) >= 6 and bool((seen > 0.0).all()))


def test_a_view_keeps_the_nearest_of_each_pixel():
    points = np.concatenate([at(a + 0.5, 1.0, e) for a in range(360) for e in (-15.0, 15.0)])
    views = Views(every=1)
    views.add(np.concatenate([points, at(45.3, 7.0), at(45.7, 6.0), at(45.4, 8.0), [[0.0, 0.0, 0.0]]]), 0)
    (image,) = views.placed(np.eye(4)[None]).images
    assert image[8, 45] == 6.0
    assert (image[[0, 15]] == 1.0).all()
    assert np.count_nonzero(image) == 2 * COLUMNS + 1


def test_of_many_points_a_part_is_enough_and_has_all_lasers_in_it():
    """128 lasers, column by column, as many sensors send them."""
    elevations, azimuths = np.meshgrid(np.linspace(-15.0, 15.0, 128), np.arange(1024) * (360.0 / 1024))
    points = np.concatenate([at(a, 5.0, e) for a, e in zip(azimuths.ravel(), elevations.ravel(), strict=True)])
    views = Views(every=1)
    views.add(points, 0)
    (image,) = views.placed(np.eye(4)[None]).images
    np.testing.assert_allclose(image, 5.0, rtol=1e-3)


def test_views_are_of_every_second_scan_and_where_these_are_in_the_end():
    views, poses = Views(), exp(np.arange(30.0)[:, None] * [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    for number in range(1, 30, 2):  # every second scan belongs in the map
        views.add(at(10.0), number)
    views.add(np.empty((0, 3)), 30)
    np.testing.assert_array_equal(views.placed(poses).T_world_lidar[:, 0, 3], np.arange(1.0, 30.0, 4.0))
    # A run that was stopped may know poses of fewer scans than were drawn.
    np.testing.assert_array_equal(views.placed(poses[:21]).T_world_lidar[:, 0, 3], np.arange(1.0, 21.0, 4.0))


def test_views_are_bounded_however_long_the_way():
    views = Views(every=1)
    assert len(views.placed(np.empty((0, 4, 4)))) == 0
    for number in range(2100):
        views.add(at(10.0), number)
        assert len(views) <= 512
    poses = exp(np.arange(2100.0)[:, None] * [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(views.placed(poses).T_world_lidar[:, 0, 3], np.arange(0.0, 2100.0, 8.0))
    assert np.asarray(views.state()["_images"]).nbytes < 6e6


def test_of_many_views_those_that_are_heard_are_from_the_whole_time():
    """Somebody stood there for a quarter of the time, at its beginning, midst or end; or for most of it."""
    for begin in (0, 120, 240):
        images = [wall(10.0)] * 320
        images[begin : begin + 80] = [wall(5.1)] * 80
        assert seen_through(at(10.0), placed(images), VOXEL_M).all()
        images[:240] = [wall(5.1)] * 240
        assert not seen_through(at(10.0), placed(images), VOXEL_M).any()


def test_views_of_several_recordings_are_joined(rng):
    """None of the two has three views."""
    parts = [placed([wall(10.0)] * 2), placed([wall(9.0)])]
    assert not any(seen_through(at(10.0), part, VOXEL_M).any() for part in parts)
    assert seen_through(at(10.0), PlacedViews.join(parts), VOXEL_M).all()
