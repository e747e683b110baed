"""The elevation bias of a sensor, against one that was added to exact rays of a street."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.datasets.mounting import correct_elevation
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.elevation import ElevationBias, ElevationEstimator, PlacedPoints, combined, estimate_bias
from lidarslam.mapping.motion.prediction import MotionState
from lidarslam.mapping.registration.sampled_scan import Sampler
from lidarslam.mapping.tracking.mapped_scan import MappedScan

EDGE_M, SCANS, STEP_M, NOISE_M = 0.8, 10, 1.5, 0.02
TRUE_DEG = 0.2


def poses() -> FloatArray:
    along = -7.0 + STEP_M * np.arange(SCANS)
    zero = np.zeros(SCANS)
    return exp(np.stack([zero, zero, 0.02 * np.arange(SCANS), along, zero, zero - 1.0], axis=-1))


def scan_at(place: Any, number: int, T: FloatArray, low_deg: float) -> FloatArray:
    """Points (N, 3) of a sensor that places them too low."""
    points = place.sweep(lambda times: np.tile(T, (len(times), 1, 1)), 0.1 * number).points
    noise = np.random.default_rng(number).normal(0.0, NOISE_M, len(points))
    return correct_elevation(points * (1.0 + noise / np.linalg.norm(points, axis=1))[:, None], -low_deg)


@pytest.fixture(scope="module")
def street(room: Any) -> Any:
    pillars = tuple((x, 7.0 * side, 0.5) for x in range(-50, 50, 9) for side in (-1, 1))
    return replace(room, half_size=(60.0, 9.0, 3.0), pillars=pillars)


def stretch(street: Any, low_deg: float) -> list[PlacedPoints]:
    """Scans at poses that are off by a centimetre and a tenth of a degree."""
    rng = np.random.default_rng(7)
    off = exp(rng.normal(0.0, [0.002] * 3 + [0.01] * 3, (SCANS, 6)))
    return [PlacedPoints(scan_at(street, number, T, low_deg), T @ off[number]) for number, T in enumerate(poses())]


@pytest.mark.parametrize("low_deg", [-TRUE_DEG, 0.0, TRUE_DEG])
def test_a_known_bias_is_found(street, low_deg):
    bias = estimate_bias(stretch(street, low_deg), EDGE_M)
    assert np.rad2deg(bias.angle) == pytest.approx(low_deg, abs=0.02)
    assert abs(np.rad2deg(bias.angle) - low_deg) < 2.0 * np.rad2deg(bias.sigma)
    assert np.rad2deg(bias.sigma) < 0.09


def test_a_common_offset_of_ranges_is_within_the_standard_deviation(street):
    scans = stretch(street, 0.0)
    off = [replace(s, points=s.points * (1.0 + 0.02 / np.linalg.norm(s.points, axis=1))[:, None]) for s in scans]
    bias = estimate_bias(off, EDGE_M)
    assert abs(bias.angle) < 2.0 * bias.sigma


def test_of_stretches_what_is_systematic_does_not_average_out_and_contradictions_widen_the_scatter():
    one = ElevationBias(0.003, 0.001, 0.0005)
    assert combined([one]) is None, "it may be wrong alone"
    bias = combined([one] * 100)
    assert (bias.angle, bias.scatter, bias.systematic) == pytest.approx((0.003, 0.0001, 0.0005))
    apart = combined([ElevationBias(angle, 0.001, 0.0) for angle in (-0.005, 0.005)])
    assert (apart.angle, apart.scatter) == pytest.approx((0.0, 0.005))


def test_a_stretch_ends_where_tracking_does(street):
    estimator, sampler = ElevationEstimator(), Sampler(MappingConfig())
    for number, T in enumerate(poses()):
        scan = sampler.sample(Scan(scan_at(street, number, T, TRUE_DEG), 0.1 * number))
        state, status = MotionState(0.0, T, np.zeros(6), np.eye(12)), Status.LOST if number % 3 == 2 else Status.OK
        estimator.add(scan, MappedScan(state, T, status is not Status.LOST, status))
    assert estimator.bias() is None
