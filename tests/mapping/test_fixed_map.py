"""Localisation in a finished map: a box-shaped room with pillars, mapped from its true surfaces."""

from typing import Any

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.localization.map_localiser import MapLocaliser
from lidarslam.mapping.localization.place_search import FixedMap, Regions
from lidarslam.mapping.tracking.mapped_scan import MappedScan

from . import runs
from .runs import poses_of, process

# The map's frame is neither that of the room nor that of a recording.
T_MAP_ROOM = exp([0.01, -0.02, 2.0, 20.0, -7.0, 1.5])
SCANS = 30


def T_room_lidar_at(times: FloatArray) -> FloatArray:
    """Another way than that of the map: from a corner, backwards, turning."""
    start = exp([0.02, -0.01, 2.4, 2.0, -3.0, 0.2])
    return start @ exp(np.multiply.outer(np.asarray(times), [0.0, 0.0, -0.2, 0.5, 0.1, 0.0]))


def scan_along(room: Any, count: int = SCANS) -> list[Scan]:
    """Scans at 10 Hz."""
    return [room.sweep(T_room_lidar_at, 0.1 * number) for number in range(count)]


def draw_map(room: Any) -> FixedMap:
    """The map of a room, scanned from a few places that no recording of these tests comes by."""
    merged = GlobalMap(0.1)
    for number, (x, y) in enumerate([(-4.0, 0.0), (0.0, 1.0), (4.0, 0.0), (1.0, -3.0)]):
        T = T_MAP_ROOM @ exp([0.0, 0.0, 0.3 * number, x, y, -0.2])
        for again in range(4):
            points = room.sweep(lambda times, T=T: np.tile(inverse(T_MAP_ROOM) @ T, (len(times), 1, 1)), 10.0 + again)
            merged.add(points.points, T)
    cloud = merged.cloud()
    return FixedMap(cloud.points, cloud.normals)


def errors(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Metres and degrees (N,) off the truth of the first N scans of `scan_along`."""
    return runs.errors(poses, T_MAP_ROOM @ T_room_lidar_at(0.1 * np.arange(len(poses))))


@pytest.fixture(scope="module")
def room_map(uneven_room: Any) -> FixedMap:
    return draw_map(uneven_room)


@pytest.fixture(scope="module")
def localised(uneven_room: Any, room_map: FixedMap) -> tuple[MapLocaliser, list[MappedScan]]:
    localiser = MapLocaliser(MappingConfig(), room_map)
    return localiser, process(localiser, scan_along(uneven_room))


def test_is_found_without_a_guess_and_tracked(localised):
    localiser, mapped = localised
    (found,) = localiser.found
    assert found.scan < 15
    assert found.confirmed - found.scan >= 10
    off_m, off_deg = errors(poses_of(mapped))
    assert off_m[found.scan :].max() < 0.03
    assert off_deg[found.scan :].max() < 0.5
    assert [one.status for one in mapped[found.confirmed :]] == [Status.OK] * (SCANS - found.confirmed)
    assert all(one.status is Status.LOST for one in mapped[: found.scan])
    assert not any(one.added for one in mapped)


def test_scans_before_the_place_are_placed_by_the_recordings_own_map(localised):
    localiser, _ = localised
    first = localiser.found[0].scan
    assert localiser.placed_afterwards == list(range(first))
    off_m, _ = errors(np.array([localiser.corrections[number] for number in range(first)]))
    assert off_m.max() < 0.1


@pytest.mark.long
def test_of_two_places_that_fit_alike_none_is_taken_unless_one_is_guessed(room):
    empty = type(room)(pillars=())  # as it is, and turned by half a turn
    empty_map = draw_map(empty)
    localiser = MapLocaliser(MappingConfig(), empty_map)
    scans = scan_along(empty)
    process(localiser, scans)
    assert not localiser.found
    assert any("fit alike" in reason for _, reason in localiser.refusals)
    x, y = (T_MAP_ROOM @ T_room_lidar_at(np.zeros(1))[0])[:2, 3] + [0.4, -0.3]
    guided = MapLocaliser(MappingConfig(), empty_map, guess=(x, y, 2.0 + 2.4 + np.deg2rad(10.0)))
    mapped = process(guided, scans)
    assert len(guided.found) == 1
    off_m, _ = errors(poses_of(mapped))
    assert off_m[guided.found[0].scan :].max() < 0.05


@pytest.mark.long
def test_a_place_that_later_scans_contradict_is_given_up(uneven_room, room_map):
    other_room = type(uneven_room)(half_size=(9.0, 3.0, 1.6), pillars=((5.0, 0.5, 0.5), (-1.0, -1.0, 0.3)))
    localiser = MapLocaliser(MappingConfig(), room_map)
    mapped = process(localiser, [*scan_along(uneven_room, 8), *scan_along(other_room, 20)[8:]])
    first = next(number for number, one in enumerate(mapped) if one.status is not Status.LOST)
    assert not localiser.found
    assert first in localiser.unconfirmed()
    assert mapped[-1].status is Status.LOST


def test_a_covered_sensor_is_lost_and_tracked_again(uneven_room, room_map):
    scans = scan_along(uneven_room, 40)
    nothing = [Scan(np.empty((0, 3)), scan.stamp, np.empty(0)) for scan in scans[28:33]]
    localiser = MapLocaliser(MappingConfig(), room_map)
    mapped = process(localiser, [*scans[:28], *nothing, *scans[33:]])
    assert [one.status for one in mapped[28:33]] == [Status.LOST] * 5
    assert mapped[-1].status is Status.OK
    off_m, _ = errors(poses_of(mapped))
    assert off_m[-3:].max() < 0.03


def test_a_map_far_from_its_origin_is_refused(rng):
    points = np.add(rng.uniform(-5.0, 5.0, (500, 3)), [4.5e6, 5e6, 0.0])
    fixed = FixedMap(points, np.tile([0.0, 0.0, 1.0], (500, 1)))
    for use in (lambda: fixed.region(points[0], 10.0, 0.1), lambda: fixed.views(0.1)):
        with pytest.raises(InputError, match=r"up to 5,000 km from its origin, and cells of 0\.1 m reach 105 km"):
            use()


def test_regions_grow_with_the_reach_of_the_scans_and_stay_when_it_shrinks(room_map):
    regions, centre = Regions(room_map, spare=0.5), T_MAP_ROOM[:3, 3]
    regions.resize(0.1, 1.0)
    narrow = regions.around(centre)
    regions.resize(0.1, 20.0)
    wide = regions.around(centre)
    assert len(wide.means()) > 3 * len(narrow.means())
    regions.resize(0.1, 1.0)
    assert regions.around(centre) is wide
