"""At which scans the odometry is asked, for poses of known motion."""

from collections.abc import Sequence
from unittest.mock import Mock

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.odometry.interface import Motion
from lidarslam.pipeline.odometry_gate import OdometryGate

from .conftest import scan_estimate

CELL_M = 0.4
VELOCITY = np.array([0.0, 0.0, 0.2, 5.0, 0.0, 0.0])


def odometry_that_answers() -> Mock:
    return Mock(**{"estimate.return_value": Motion(np.eye(4), 1), "state.return_value": {}})


def stamps_of(method: Mock) -> list[float]:
    """The stamps of the scans with which a method was called."""
    return [call.args[0].stamp for call in method.call_args_list]


def asked(
    poses: Sequence[FloatArray],
    statuses: dict[int, Status] | None = None,
    stamps: FloatArray | None = None,
    empty: int | None = None,
    behind: int = 1,
    cell_m: float | None = CELL_M,
) -> list[int]:
    """The indices of the scans that are asked for, where each pose comes so many scans late."""
    times = 0.1 * np.arange(len(poses)) if stamps is None else stamps
    odometry = odometry_that_answers()
    gate = OdometryGate(odometry)
    for index, stamp in enumerate(times):
        motion = gate.estimate(Scan(np.ones((0 if index == empty else 5, 3)), float(stamp)))
        assert motion.is_asked == (float(stamp) in stamps_of(odometry.estimate))
        done = index - behind + 1
        if done >= 0:
            status = (statuses or {}).get(done, Status.OK)
            result = scan_estimate(float(times[done]), poses[done], status, cell_m=cell_m)
            gate.follow(lambda result=result: result)
    asked, skipped = stamps_of(odometry.estimate), stamps_of(odometry.skip)
    assert sorted(asked + skipped) == times.tolist()
    return [times.tolist().index(stamp) for stamp in asked]


def steady(scans: int = 40) -> list[FloatArray]:
    return [exp(0.1 * index * VELOCITY) for index in range(scans)]


@pytest.mark.parametrize("behind", [1, 2])
def test_a_steady_motion_needs_the_odometry_for_the_first_scans_only(behind):
    assert asked(steady(), behind=behind) == list(range(10 + behind))


def test_a_change_of_velocity_needs_it_until_predictions_are_good_again():
    poses = steady(20) + [exp(1.9 * VELOCITY) @ exp(0.1 * index * 1.6 * VELOCITY) for index in range(1, 61)]
    later = [index for index in asked(poses) if index > 11]
    assert later[0] == 21
    assert later == list(range(21, later[-1] + 1))
    assert 30 < later[-1] < 40


@pytest.mark.parametrize("status", [Status.LOST, Status.DEGRADED])
def test_it_is_asked_from_the_scan_after_one_that_is_not_ok(status):
    assert [index for index in asked(steady(), {20: status}) if index > 11] == list(range(21, 32))


def test_after_a_gap_and_at_an_empty_scan_it_is_asked():
    stamps = 0.05 * np.arange(40)
    stamps[25:] += 0.05
    poses = [exp(stamp * VELOCITY) for stamp in stamps]
    assert [index for index in asked(poses, stamps=stamps) if index > 10] == [25]
    assert 30 in asked(steady(), empty=30)


def test_at_a_low_rate_and_without_a_local_map_of_known_cells_it_is_always_asked():
    assert asked(steady(), stamps=0.2 * np.arange(40)) == list(range(40))
    assert asked(steady(), cell_m=None) == list(range(40))


def test_only_results_that_can_matter_are_waited_for():
    gate = OdometryGate(odometry_that_answers())
    taken = []
    for index, pose in enumerate(steady(12)):
        stamp = 0.1 * index
        gate.estimate(Scan(np.ones((5, 3)), stamp))
        if index < 8:
            assert not taken
        result = scan_estimate(stamp, pose, cell_m=CELL_M)
        gate.follow(lambda index=index, result=result: (taken.append(index), result)[1])
    gate.state()
    assert taken == list(range(12))
