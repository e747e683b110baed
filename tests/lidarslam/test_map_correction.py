"""A local map drawn anew replaces the running one at a scan that depends on neither threads nor interruptions."""

import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from lidarslam.config.settings import load_config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.state import State
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import GlobalMapConfig, MappingConfig
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan
from lidarslam.mapping.pose_graph.submap_placement import SCANS_LATER
from lidarslam.mapping.registration.sampled_scan import CellSizes
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import ScanToMap, make_localiser
from lidarslam.pipeline.pipeline import Pipeline

CONFIG = MappingConfig(radius_m=30.0, keypoints=800)
CLOSED_AT = 3
APART = np.array([0.1, -0.06, 0.0])


class Graph:
    """Draws the map of the scans so far, shifted, when a scan closes a loop."""

    def __init__(self, delay_s: float = 0.0, fails: bool = False, closes: bool = True) -> None:
        self.delay_s, self.fails, self.closes = delay_s, fails, closes
        self.scans: list[GraphScan] = []

    def draw(self, *_: Any) -> None:
        time.sleep(self.delay_s)

    def add(self, scan: GraphScan) -> None:
        time.sleep(self.delay_s)
        self.scans.append(scan)

    def redrawn_local_map(self, cells_m: CellSizes) -> SurfelMap | None:
        if len(self.scans) - 1 != CLOSED_AT or not self.closes:
            return None
        if self.fails:
            raise InputError("no room left")
        drawn = SurfelMap(cells_m, CONFIG.radius_m)
        for scan in self.scans[:-1]:
            points = transform_points(scan.T_world_lidar, scan.points) + APART
            drawn.insert(points, np.linspace(-0.2, 0.2, len(points)), scan.T_world_lidar[:3, 3] + APART)
        return drawn


class Keeper:
    """Keeps the state once, after so many scans, and the scans that the graph had by then."""

    def __init__(self, at: int, graph: Graph, through_disk: Callable[[State], State]) -> None:
        self._at, self._graph, self._through_disk = at, graph, through_disk
        self._asked = 0
        self.saved: State | None = None
        self.scans: list[GraphScan] = []

    def is_due(self) -> bool:
        self._asked += 1
        return self._asked == self._at

    def save(self, pipeline: Pipeline) -> None:
        self.saved, self.scans = self._through_disk(pipeline.state()), list(self._graph.scans)


def pipeline_of(odometry: ExternalOdometry, graph: Any, keeper: Keeper | None = None) -> Pipeline:
    localiser = ScanToMap(Mapper(CONFIG, kept_scans=SCANS_LATER))
    return Pipeline(odometry, localiser, GlobalMapConfig(voxel_size_m=0.1), graph, keeper)


def poses(results: Iterable[ScanEstimate]) -> FloatArray:
    return np.array([result.T_world_lidar for result in results])


@pytest.fixture(scope="module")
def poses_with(room_scans: list[Scan], room_truth: Trajectory) -> Callable[..., FloatArray]:
    """The poses of a run with a graph, whose state may be kept."""
    return lambda graph, *keeper: poses(pipeline_of(ExternalOdometry(room_truth), graph, *keeper).run(room_scans))


@pytest.fixture(scope="module")
def corrected(poses_with: Callable[..., FloatArray]) -> FloatArray:
    return poses_with(Graph())


def test_the_map_is_replaced_so_many_scans_after_the_closure(corrected, poses_with):
    as_it_was = poses_with(Graph(closes=False))
    first = CLOSED_AT + SCANS_LATER
    assert len(corrected) > first + 3
    np.testing.assert_array_equal(corrected[:first], as_it_was[:first])
    shift = corrected[first + 1 :, :3, 3] - as_it_was[first + 1 :, :3, 3]
    # Between the shifted map of three scans and the twelve scans since, which are where they were.
    assert (shift @ APART > 0.1 * (APART @ APART)).all()


def test_it_does_not_depend_on_how_fast_the_graph_is(corrected, poses_with):
    np.testing.assert_array_equal(poses_with(Graph(delay_s=0.02)), corrected)


@pytest.mark.parametrize("at", [CLOSED_AT, CLOSED_AT + 4, CLOSED_AT + SCANS_LATER + 2])
def test_a_map_that_waits_is_in_the_state(corrected, poses_with, room_scans, room_truth, through_disk, at):
    graph, rest = Graph(), Graph()
    keeper = Keeper(at, graph, through_disk)
    poses_with(graph, keeper)
    rest.scans = keeper.scans
    odometry = ExternalOdometry(room_truth)
    resumed = pipeline_of(odometry, rest)
    resumed.restore(keeper.saved)
    odometry.estimate(resumed.held.scan)
    done = len(keeper.scans)
    assert resumed.held.scan.stamp == room_scans[done].stamp
    np.testing.assert_array_equal(poses(resumed.run(room_scans[done + 1 :])), corrected[done:])


def test_an_error_while_drawing_reaches_the_caller(poses_with):
    with pytest.raises(InputError, match="no room left"):
        poses_with(Graph(fails=True))


def test_a_map_that_has_begun_since_stays(room_scans):
    mapper = Mapper(CONFIG, kept_scans=SCANS_LATER)
    for scan in room_scans[:6]:  # the map begins anew with the second one, when the first one's velocity is known
        mapper.process(mapper.sample(scan), Prior())
    begun, cells_m = mapper.local_map, mapper.local_map.cells_m
    assert not mapper.redraw(SurfelMap(cells_m, CONFIG.radius_m), 5)
    assert mapper.local_map is begun
    drawn = SurfelMap(cells_m, CONFIG.radius_m)
    assert mapper.redraw(drawn, 4)
    assert mapper.local_map is drawn
    assert mapper.process(mapper.sample(room_scans[6]), Prior()).registered  # to the last four scans, which are in it


@pytest.mark.parametrize(("settings", "kept_scans"), [
    (["pose_graph.enabled=true"], SCANS_LATER), (["pose_graph.enabled=true", "pose_graph.corrects_local_map=false"], 0),
    ([], 0),
])  # fmt: skip
def test_runs_with_a_graph_correct_their_map_unless_told_otherwise(settings, kept_scans):
    mapper = make_localiser(load_config(None, settings)).mapper
    assert mapper.kept_scans == kept_scans
