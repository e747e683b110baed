"""Maps brought back to where they were taken from."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse, rotation_angle, transform_points
from lidarslam.core.thinning import first_per_cell
from lidarslam.evaluation.map.alignment import align_map

from ..mapping.shapes import on_boxes

UTM = np.array([5e5, 5e6, 300.0])
THREADS = """
import numpy as np
from lidarslam.evaluation.map.alignment import align_map
rng = np.random.default_rng(0)
walls = np.concatenate([rng.uniform(-9.0, 9.0, (6000, 3)) * flat for flat in 1.0 - np.eye(3)])
found = align_map(walls + rng.normal(0.05, 0.01, walls.shape), walls, {"guess": np.eye(4)})
print(found.T_reference_map.tobytes().hex())
"""


@pytest.fixture(scope="module")
def building() -> FloatArray:
    """A room with furniture that stands nowhere twice alike, and a smaller room beside it."""
    rng = np.random.default_rng(7)
    boxes = [
        ((7, 4.5, 1.5), (7, 4.5, 1.5)), ((16.5, 4.5, 1.25), (2.5, 2.5, 1.25)), ((2.5, 2.5, 0.6), (0.5, 1.5, 0.6)),
        ((7.5, 6.5, 0.4), (1.5, 0.5, 0.4)), ((11.3, 1.3, 1.5), (0.3, 0.3, 1.5)), ((4.75, 6, 1.1), (0.25, 1, 1.1)),
        ((16.75, 4.5, 0.5), (0.75, 0.5, 0.5)), ((8.75, 2.5, 0.8), (0.75, 0.5, 0.8)),
    ]  # fmt: skip
    return on_boxes(boxes, 1.0 / 25.0, rng)


def _error(T_a: FloatArray, T_b: FloatArray, points: FloatArray) -> float:
    return float(np.linalg.norm(transform_points(T_a, points) - transform_points(T_b, points), axis=1).max())


@pytest.mark.parametrize(("xi", "origin", "guesses"), [
    ([0.0, 0.0, 1.8, 3.0, -20.0, 1.0], np.zeros(3), {}), ([0.02, -0.03, -2.9, 0.0, 7.0, 0.0], UTM, {"none": np.eye(4)}),
], ids=["without a guess", "far away, with a wrong one"])  # fmt: skip
def test_a_turned_map_is_found(building, rng, xi, origin, guesses):
    part = building[building[:, 0] < 16.0]
    T_reference_map = exp(xi)
    T_reference_map[:3, 3] += origin
    seen = transform_points(inverse(T_reference_map), part + origin + rng.normal(0.0, 0.01, part.shape))
    # Only half of the cloud is the same points, so that no point meets itself by design.
    found = align_map(seen[::2], building + origin, guesses, search=True)
    assert found.method == "global"
    assert found.is_trustworthy
    assert found.fitness > 0.99
    assert found.runner_up < 0.9 * found.fitness
    assert _error(found.T_reference_map, T_reference_map, seen) < 0.03


def test_a_guess_is_refined_and_the_correction_told(building):
    T_off = exp([0.0, 0.0, 0.02, 0.2, -0.1, 0.05])
    seen = transform_points(inverse(T_off), building[::2])
    found = align_map(seen, building, {"file": np.eye(4)})
    assert _error(found.T_reference_map, T_off, building) < 0.01
    assert found.moved_deg == pytest.approx(np.rad2deg(rotation_angle(T_off)), abs=0.02)
    middle = np.median(first_per_cell(seen, 0.1), axis=0, keepdims=True)
    assert found.moved_m == pytest.approx(_error(T_off, np.eye(4), middle), abs=0.01)
    assert found.refined


def test_without_refinement_the_guess_stands(building):
    T_off = exp([0.0, 0.0, 0.0, 0.15, 0.0, 0.0])
    found = align_map(building, building, {"none": T_off}, refine=False)
    np.testing.assert_allclose(found.T_reference_map, T_off, atol=1e-12)
    assert (found.moved_m, found.refined, found.method) == (0.0, False, "none")


def test_a_guess_that_fits_needs_no_search(building):
    T_true = exp([0.0, 0.0, 2.0, 30.0, 0.0, 0.0])
    seen = transform_points(inverse(T_true), building[::2])
    assert align_map(seen, building, {"trajectory": T_true}, search=True).method == "trajectory"


def test_a_guess_at_which_floors_and_half_of_the_walls_coincide_is_rejected():
    """An L-shaped room, turned by 180 degrees, has 60 % of its points on the other's surfaces."""
    rng = np.random.default_rng(0)
    wide, deep = (on_boxes([((x, y, 1.3), (x, y, 1.3))], 1.0 / 30.0, rng) for x, y in ((7.0, 2.5), (3.0, 6.0)))
    room = np.concatenate([wide[(wide[:, 0] > 6.0) | (wide[:, 1] < 5.0)], deep[deep[:, 1] > 5.0]])
    T_reference_map = exp([0.0, 0.0, np.pi, 5.0, 3.0, 0.0])
    seen = transform_points(inverse(T_reference_map), room + rng.normal(0.0, 0.01, room.shape))
    found = align_map(seen, room, {"given": np.eye(4)}, search=True)
    assert found.method == "global"
    assert _error(found.T_reference_map, T_reference_map, seen) < 0.01


@pytest.mark.long
def test_another_place_is_refused(building):
    rng = np.random.default_rng(3)
    elsewhere = rng.uniform(0.0, 12.0, (4_000, 3))
    with pytest.raises(InputError, match=r"cannot be aligned with its reference .* --map-alignment FILE"):
        align_map(elsewhere, building, {"none": np.eye(4)}, search=True)
    taken = align_map(elsewhere + 100.0, building, {"none": np.eye(4)})
    assert not taken.is_trustworthy
    assert taken.fitness == 0.0
    assert taken.inlier_rmse_m is None


def test_a_place_with_two_fitting_poses_is_refused():
    """An empty box looks the same when it is turned by 180 degrees."""
    box = on_boxes([((6, 4, 1.5), (6, 4, 1.5))], 1.0 / 25.0, np.random.default_rng(0))
    seen = transform_points(exp([0.0, 0.0, 1.2, 1.0, 2.0, 0.0]), box[::2])
    with pytest.raises(InputError, match="at more than one pose"):
        align_map(seen, box, {}, search=True)


@pytest.mark.long
def test_the_pose_is_the_same_for_any_number_of_threads():
    """Sums of several threads have no fixed order."""
    root = str(Path(__file__).parents[2])
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    poses, command = set(), [sys.executable, "-c", THREADS]
    for threads in ("1", "3"):
        environment = os.environ | {"PYTHONPATH": root} | dict.fromkeys(names, threads)
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        poses.add(done.stdout)
    assert len(poses) == 1
