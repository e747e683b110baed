"""From odometry to a pose: when it is asked, the motion during a sweep, and the way through the whole pipeline."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.sampled_scan import CellSizes, sizes_of_cells
from lidarslam.mapping.smoothed_start import SMOOTHED, smoothed_start
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.pipeline.estimates import ScanEstimate, ScanOdometry, SweepMotion
from lidarslam.pipeline.localisation import OdometryAlone, ScanToMap, make_localiser
from lidarslam.pipeline.odometry_gate import OdometryGate

from ..mapping.runs import errors
from .conftest import scan_estimate

BEFORE, AFTER = np.arange(6.0), np.arange(6.0) ** 2 - 3.0


def sweep(begin: float, end: float) -> Scan:
    offsets = np.linspace(begin, end, 11)
    return Scan(np.ones((11, 3)), 0.0, offsets)


@pytest.mark.parametrize(
    ("begin", "end", "share_after"),
    [(0.0, 0.1, 1.0), (-0.1, 0.0, 0.0), (-0.05, 0.05, 0.5), (-0.075, 0.025, 0.25), (0.02, 0.1, 1.0)],
    ids=["stamped at the start", "at the end", "in the middle", "late", "before its start"],
)
def test_the_mean_motion_counts_how_much_of_the_sweep_lies_after_the_stamp(begin, end, share_after):
    mean = SweepMotion(BEFORE, AFTER).mean(sweep(begin, end))
    np.testing.assert_allclose(mean, share_after * AFTER + (1.0 - share_after) * BEFORE, atol=1e-12)


def test_a_motion_known_on_one_side_only_serves_for_the_other():
    scan = sweep(-0.05, 0.05)
    np.testing.assert_array_equal(SweepMotion(BEFORE, None).mean(scan), BEFORE)
    np.testing.assert_array_equal(SweepMotion(None, AFTER).mean(scan), AFTER)
    assert SweepMotion(None, None).mean(scan) is None


def test_a_direction_of_which_nothing_is_seen_is_told_without_mapping_too():
    """Standing still in a corner, of which the odometry says that it leaves nothing open, and that it leaves x open."""
    rng = np.random.default_rng(0)
    corner = np.concatenate([np.insert(rng.uniform(1.0, 6.0, (800, 2)), axis, 1.0, axis=1) for axis in range(3)])
    localiser = OdometryAlone(ConsistencyCheck())
    motions = [Motion(np.eye(4), 100, degenerate=names) for names in ((), (), ("x", "yaw"))]
    scans = [ScanOdometry(Scan(corner, 0.1 * number), motion, 0.1) for number, motion in enumerate(motions)]
    _, seen, open_ = [localiser.localise(scan, None) for scan in scans]
    assert (seen.status, seen.message) == (Status.OK, "")
    assert (open_.status, open_.message) == (Status.DEGRADED, "degenerate along x, yaw")
    assert open_.degenerate == ("x", "yaw")


def localise_all(
    scans: list[Scan], motions: list[Motion], interval_s: float = 0.1, start: dict[float, Prior] | None = None
) -> list[ScanEstimate]:
    localiser = ScanToMap(Mapper(MappingConfig()), start=start)
    intervals = [None, *(interval_s if b.failure is a.failure is None else None for a, b in pairwise(motions))]
    estimates = [ScanOdometry(*given) for given in zip(scans, motions, intervals, strict=True)]
    return [localiser.localise(one, following) for one, following in pairwise([*estimates, None])]


def true_motions(truth: FloatArray, variance: float) -> list[Motion]:
    """As an odometry without errors tells them, which believes in such ones."""
    return [Motion(T, 100, covariance=variance * np.eye(6)) for T in (np.eye(4), *(inverse(truth[:-1]) @ truth[1:]))]


def errors_of(localised: list[ScanEstimate], truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Metres (N,) and degrees (N,), in the world of the first scan."""
    return errors(np.array([result.T_world_lidar for result in localised]), inverse(truth[0]) @ truth)


def test_the_odometrys_own_path_is_its_motions_or_the_mappers_where_it_measured_nothing(room_scans, room_truth, rng):
    errors = exp(rng.normal(0.0, [0.01] * 3 + [0.02] * 3, (len(room_scans) - 1, 6)))
    wrong = [np.eye(4), *(room_truth.relative_motions() @ errors)]
    localised = localise_all(room_scans, [Motion(T, 100) for T in wrong])
    chained = list(accumulate(wrong, np.matmul))
    np.testing.assert_allclose([found.T_odom_lidar for found in localised], chained, atol=1e-9)
    assert np.linalg.norm(chained[-1][:3, 3] - localised[-1].T_world_lidar[:3, 3]) > 0.02, "but not the pose"
    nothing = [Motion(np.eye(4), 0, "covered") for _ in room_scans]
    localised = localise_all(room_scans, nothing)
    moved = np.linalg.norm(localised[-1].T_odom_lidar[:3, 3])
    true_path = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar[-1]
    assert moved == pytest.approx(np.linalg.norm(true_path[:3, 3]), abs=0.2)


@pytest.mark.long
def test_a_robot_that_begins_to_turn_on_the_spot_does_not_bend_its_map(room):
    """From 20 to 180 deg/s around the first sweep: the odometry's motion to the second is not the first one's."""

    def turning(times: FloatArray) -> FloatArray:
        since = times + 0.1
        degrees = 20.0 * since + 400.0 * np.clip(since, 0.0, 0.2) ** 2 + 160.0 * np.maximum(since - 0.2, 0.0)
        return exp(np.multiply.outer(np.deg2rad(degrees), [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))

    stamps = 0.2 * np.arange(SMOOTHED)
    scans, truth = [room.ring_sweep(turning, stamp) for stamp in stamps], turning(stamps)
    start = smoothed_start(scans, MappingConfig()).motions
    assert list(start) == [0.0]
    assert np.rad2deg(start[0.0].turn_rate) == pytest.approx([0.0, 0.0, 100.0], abs=10.0)
    distances_m, angles_deg = errors_of(localise_all(scans, true_motions(truth, 1e-6), 0.2, start), truth)
    assert distances_m.max() < 0.02
    assert angles_deg.max() < 0.5


@pytest.mark.parametrize(("sigma", "share"), [(0.0, 1.0), (0.5e-3, 0.5), (1e-2, 0.0)])
def test_a_turn_accelerates_as_far_as_noise_does_not_explain_it(sigma, share):
    """The variances of both velocities, 100 sigma^2 each, add up."""
    change = np.full(6, 0.01)
    before, after = (
        ScanOdometry(sweep(0.0, 0.1), Motion(exp(0.1 * velocity), 100, covariance=sigma**2 * np.eye(6)), 0.1)
        for velocity in (BEFORE, BEFORE + change)
    )
    assert before.turn_acceleration(after) == pytest.approx(share * change[:3] / 0.1, abs=1e-9)
    assert before.turn_acceleration(None) is None


def test_a_robot_that_sways_as_it_walks_is_not_seen_to_sway_more(room):
    """Three degrees of pitch and roll at two steps a second: the rates change by 50 deg/s within a sweep."""

    def swaying(times: FloatArray) -> FloatArray:
        angle, zero = 3.0 * np.pi * times, np.zeros(len(times))
        turns = 3.0 * np.stack([np.sin(0.5 * angle), np.sin(angle), zero], axis=1)
        return make_transform(Rotation.from_rotvec(turns, True).as_matrix(), [0.3, 0.0, 0.0] * times[:, None])

    stamps = 0.1 * np.arange(30)
    scans, truth = [room.ring_sweep(swaying, stamp) for stamp in stamps], swaying(stamps)
    distances_m, angles_deg = errors_of(localise_all(scans, true_motions(truth, 1e-5)), truth)
    settled = slice(5, -1)  # not in a young map, nor at the last scan, whose following motion is unknown
    assert angles_deg[settled].max() < 0.08
    assert distances_m[settled].max() < 0.01


def test_the_configuration_chooses_the_map(room_scans):
    for method, kind in (("surfels", SurfelMap), ("loam", FeatureMap)):
        mapper = make_localiser(Config(mapping=MappingConfig(method=method))).mapper
        mapper.process(mapper.sample(room_scans[0]), Prior())
        assert type(mapper.local_map) is kind
    assert isinstance(make_localiser(Config(mapping=MappingConfig(method="off"))), OdometryAlone)


def test_scans_may_be_thinned_ahead_of_their_poses(room_scans, room_truth):
    """As many ahead as the pipeline has scans under way."""
    motions = [np.eye(4), *room_truth.relative_motions()]
    estimates = [ScanOdometry(scan, Motion(T, 100), 0.1) for scan, T in zip(room_scans[:8], motions, strict=False)]
    in_turn, ahead = make_localiser(Config()), make_localiser(Config())
    sampled = [replace(one, sampled=ahead.sample(one.scan)) for one in estimates]
    for one, other in zip(estimates, sampled, strict=True):
        first, second = in_turn.localise(one, None), ahead.localise(other, None)
        assert second.status is Status.OK
        np.testing.assert_array_equal(first.T_world_lidar, second.T_world_lidar)
    assert make_localiser(Config(mapping=MappingConfig(method="off"))).sample(estimates[0].scan) is None


CELL_M = 0.4
CELLS_M = sizes_of_cells(CELL_M)
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
    cells_m: CellSizes | None = CELLS_M,
    wider_from: int | None = None,
    saved_at: int | None = None,
) -> list[int]:
    """The indices of the scans that are asked for, where each pose comes so many scans late.

    The cells of the map double at one scan, and the state is saved before another.
    """
    times = 0.1 * np.arange(len(poses)) if stamps is None else stamps
    odometry = odometry_that_answers()
    gate = OdometryGate(odometry)
    for index, stamp in enumerate(times):
        if index == saved_at:
            gate.state()
        motion = gate.estimate(Scan(np.ones((0 if index == empty else 5, 3)), float(stamp)))
        assert motion.is_asked == (float(stamp) in stamps_of(odometry.estimate))
        done = index - behind + 1
        if done >= 0:
            status = (statuses or {}).get(done, Status.OK)
            is_wider = wider_from is not None and done >= wider_from
            present_m = sizes_of_cells(2.0 * CELL_M) if is_wider else cells_m
            result = scan_estimate(float(times[done]), poses[done], status, cells_m=present_m)
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
    assert later == list(range(22, later[-1] + 1))
    assert 30 < later[-1] < 40


@pytest.mark.parametrize("status", [Status.LOST, Status.DEGRADED])
def test_it_is_asked_from_the_second_scan_after_one_that_is_not_ok(status):
    assert [index for index in asked(steady(), {20: status}) if index > 11] == list(range(22, 32))


def test_after_a_gap_and_at_an_empty_scan_it_is_asked():
    stamps = 0.05 * np.arange(40)
    stamps[25:] += 0.05
    poses = [exp(stamp * VELOCITY) for stamp in stamps]
    assert [index for index in asked(poses, stamps=stamps) if index > 10] == [25]
    assert 30 in asked(steady(), empty=30)


def test_at_a_low_rate_and_without_a_local_map_of_known_cells_it_is_always_asked():
    assert asked(steady(), stamps=0.2 * np.arange(40)) == list(range(40))
    assert asked(steady(), cells_m=None) == list(range(40))


def test_the_choice_does_not_depend_on_when_the_state_is_saved(rng):
    """A shaken sensor that leaves a narrow place, where the cells of the map grow."""
    poses = [T @ exp([0.0, 0.0, 0.0, *rng.normal(0.0, 0.03, 3)]) for T in steady(60)]
    never = asked(poses, behind=2, wider_from=20)
    assert 20 < len(never) < 60
    for scan in range(12, 40):
        assert asked(poses, behind=2, wider_from=20, saved_at=scan) == never


def test_only_results_that_can_matter_are_waited_for():
    gate = OdometryGate(odometry_that_answers())
    taken = []
    for index, pose in enumerate(steady(12)):
        stamp = 0.1 * index
        gate.estimate(Scan(np.ones((5, 3)), stamp))
        if index < 8:
            assert not taken
        result = scan_estimate(stamp, pose, cells_m=CELLS_M)
        gate.follow(lambda index=index, result=result: (taken.append(index), result)[1])
    gate.state()
    assert taken == list(range(12))
