"""Points and scans beyond the reach of voxels and cells: left out and counted, never merged."""

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import GlobalMapConfig, MappingConfig
from lidarslam.mapping.global_map.drawing import drawn_map
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.global_map.moved_points import Views
from lidarslam.mapping.localization.place_search import FixedMap
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.surfels.voxel_hash import reach_m
from lidarslam.mapping.tracking.mapper import Mapper


def test_a_map_leaves_out_what_its_voxels_do_not_reach(rng):
    points = rng.uniform(-5.0, 5.0, (500, 3))
    whole, moved = GlobalMap(0.05), GlobalMap(0.05)
    whole.add(points, np.eye(4))
    moved.add(points, np.eye(4))
    for distance_m in (-1e7, 60_000.0, 1e12):
        moved.add(points, exp([0.0, 0.0, 0.0, 0.0, distance_m, 0.0]))
    moved.add_means(whole.means(), exp([0.0, 0.0, 0.0, 1e7, 0.0, 0.0]))
    np.testing.assert_array_equal(moved.points(), whole.points())
    assert moved.beyond == 1500 + len(whole.points())
    drawn = drawn_map(moved, Views().placed(np.empty((0, 4, 4))), GlobalMapConfig())
    assert "voxels of 0.05 m reach, 52 km, and are not in the map" in drawn.warning


def test_points_up_to_the_reach_are_in_the_map(rng):
    points = rng.uniform(-5.0, 5.0, (500, 3))
    far = GlobalMap(0.05)
    far.add(points, exp([0.0, 0.0, 0.0, reach_m(0.05) - 6.0, 0.0, 0.0]))
    near = GlobalMap(0.05)
    near.add(points, np.eye(4))
    assert far.beyond == 0
    assert len(far.points()) == pytest.approx(len(near.points()), rel=0.1)


@pytest.mark.parametrize("method", ["surfels", "loam"])
def test_a_scan_beyond_the_reach_of_the_cells_is_lost_with_the_reason(method, room, drive):
    tracker = Mapper(MappingConfig(method=method, cell_m=0.05, max_range_m=30.0))
    tracker.process(tracker.sample(room.ring_sweep(drive, 0.1)), Prior(T_prev_curr=np.eye(4)))
    T_prev_curr = exp([0.0, 0.0, 0.0, 1e7, 0.0, 0.0])
    mapped = tracker.process(
        tracker.sample(room.ring_sweep(drive, 0.2)), Prior(T_prev_curr=T_prev_curr, covariance=1e-12 * np.eye(6))
    )
    assert mapped.status is Status.LOST
    assert mapped.message == "beyond the reach of a map with cells of 0.05 m, 52 km"


def test_a_map_far_from_its_origin_is_refused(rng):
    points = np.add(rng.uniform(-5.0, 5.0, (500, 3)), [4.5e6, 5e6, 0.0])
    fixed = FixedMap(points, np.tile([0.0, 0.0, 1.0], (500, 1)))
    for use in (lambda: fixed.region(points[0], 10.0, 0.1), lambda: fixed.views(0.1)):
        with pytest.raises(InputError, match=r"up to 5,000 km from its origin, and cells of 0\.1 m reach 105 km"):
            use()
