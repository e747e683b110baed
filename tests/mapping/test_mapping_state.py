"""A mapper and a map that are saved and restored go on as they would have, to the last bit."""

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper

from .runs import process


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarslam.mapping.tracking.tracking_state.GIVE_UP_AFTER", 2)


@pytest.fixture(scope="module")
def scans(room_scans: list[Scan]) -> list[Scan]:
    """Thinned sweeps; two are of points that lie on nothing, so that the map is begun anew, and one is empty."""
    chosen = [scan.select(np.arange(0, len(scan), 3)) for scan in room_scans[:12]]
    for index in (5, 6):
        noise = np.random.default_rng(index).uniform(-6.0, 6.0, (2000, 3))
        chosen[index] = Scan(noise, chosen[index].stamp, np.linspace(0.0, 0.1, 2000))
    chosen[9] = chosen[9].select(np.arange(0))
    return chosen


def assert_same(found: MappedScan, expected: MappedScan) -> None:
    for name, value in vars(expected.state).items():
        np.testing.assert_array_equal(getattr(found.state, name), value, err_msg=name)
    np.testing.assert_array_equal(found.T_world_predicted, expected.T_world_predicted)
    for name in ("registered", "status", "message", "fit", "degenerate", "iterations", "added", "is_connected"):
        assert getattr(found, name) == getattr(expected, name), name


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "recording", "resumed_after"), [("surfels", "scans", (1, 6, 8)), ("loam", "ring_scans", (1, 7))]
)
def test_a_mapper_goes_on(through_disk, request, method, recording, resumed_after):
    config, scans = MappingConfig(keypoints=600, method=method), request.getfixturevalue(recording)[:12]
    expected = process(Mapper(config), scans)
    assert Status.OK in {mapped.status for mapped in expected}
    assert any("a new map" in mapped.message for mapped in expected) == (method == "surfels")
    for after in resumed_after:
        first, second = Mapper(config), Mapper(config)
        process(first, scans[:after])
        second.restore(through_disk(first.state()))
        for found, mapped in zip(process(second, scans[after:]), expected[after:], strict=True):
            assert_same(found, mapped)


@pytest.mark.parametrize("tidied_after", [1_000, 3])
def test_a_map_that_has_forgotten_goes_on(rng, through_disk, monkeypatch, tidied_after):
    """Rows of cells are in the order in which they came, also after some were dropped."""
    monkeypatch.setattr("lidarslam.mapping.surfels.surfel_map._TIDIED_AFTER", tidied_after)

    def add(local_map: SurfelMap, step: int, seed: int) -> None:
        points = np.random.default_rng(seed).uniform(-4.0, 4.0, (3000, 3)) + np.array([2.0 * step, 0.0, 0.0])
        local_map.insert(points, np.zeros(3000), np.array([2.0 * step, 0.0, 0.0]))

    whole = SurfelMap(0.3, 6.0)
    for step in range(4):
        add(whole, step, step)
    restored = SurfelMap(0.3, 6.0)
    restored.restore(through_disk(whole.state()))
    assert len(restored) == len(whole)
    queries = rng.uniform(-4.0, 12.0, (2000, 3))
    for step in range(4, 8):
        add(whole, step, step)
        add(restored, step, step)
        found = restored.match(queries, np.eye(4))
        for name, value in vars(whole.match(queries, np.eye(4))).items():
            np.testing.assert_array_equal(getattr(found, name), value)
