"""Who passes a sensor is not in the map that a run leaves behind, and what stands is."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.localisation import OdometryAlone
from lidarslam.pipeline.pipeline import Pipeline

from ..conftest import Room, succeeds, write_recording

SCANS = 60
PASSES_UNTIL = 15
HALF_SIZE = (5.0, 4.0, 1.4)


def truth() -> Trajectory:
    """A slow way through the room, as seen from its first scan."""
    phase = np.linspace(0.0, 1.0, SCANS)[:, None]
    stamps = np.arange(1, SCANS + 1, dtype=np.float64) / 10.0
    return Trajectory(stamps, exp(phase * [0.0, 0.0, 0.4, 1.0, 0.3, 0.0]))


@pytest.fixture(scope="module")
def scans(room: Room) -> list[Scan]:
    """What is seen of walls, floor and ceiling, and of somebody who walks along y during the first scans."""
    rng, found = np.random.default_rng(0), []
    for number, (stamp, pose) in enumerate(zip(truth().stamps, truth().T_world_lidar, strict=True)):
        somebody = ((2.5, -2.0 + 0.2 * number, 0.22),) if number < PASSES_UNTIL else ()
        seen = replace(room, half_size=HALF_SIZE, pillars=somebody).ring_sweep(
            lambda times, pose=pose: np.tile(pose, (len(times), 1, 1)), float(stamp), rings=16, columns=600
        )
        found.append(Scan(seen.points * (1.0 + 0.003 * rng.normal(size=(len(seen), 1))), float(stamp)))
    return found


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, scans: list[Scan]) -> Path:
    """A folder of them, with their trajectory."""
    return write_recording(tmp_path_factory.mktemp("data") / "room", scans, truth())


def run(source: Path, out: Path, *arguments: str) -> str:
    prior = ("--no-mapping", "--prior", source / "ground_truth.tum")
    return succeeds("run", source, "--out", out, *prior, "--set", "global_map.voxel_size_m=0.1", *arguments)


def written(cloud: Path) -> FloatArray:
    return np.asarray(o3d.io.read_point_cloud(cloud).points)


def of_person(points: FloatArray) -> FloatArray:
    """Those farther than 40 cm from all that stands."""
    return np.asarray(points[(HALF_SIZE - np.abs(points)).min(axis=1) > 0.4])


@pytest.mark.long
def test_who_passed_is_not_in_the_map(source, tmp_path):
    said = run(source, tmp_path / "without")
    run(source, tmp_path / "with", "--set", "global_map.leave_out_moved=false")
    all_points, points = (written(tmp_path / name / "map.ply") for name in ("with", "without"))
    assert len(of_person(all_points)) > 300
    assert len(of_person(points)) < 0.2 * len(of_person(all_points))
    stands = len(all_points) - len(of_person(all_points))
    assert stands - (len(points) - len(of_person(points))) < 0.02 * stands
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("without", "with")]
    left_out = len(all_points) - len(points)
    assert [summary["map_points_moved"] for summary in summaries] == [left_out, 0]
    assert [summary["map_points"] for summary in summaries] == [len(points), len(all_points)]
    assert f"voxels of 10 cm; {left_out:,} points of moving objects removed" in said


@pytest.mark.long
def test_the_last_map_that_rerun_shows_is_the_written_one(source, tmp_path):
    from rerun.chunk import RrdReader

    run(source, tmp_path / "run", "--rerun", "save")
    shown = [
        batch.column("Points3D:positions")[row].values.to_numpy(zero_copy_only=False)
        for chunk in RrdReader(tmp_path / "run" / "recording.rrd").stream()
        if chunk.entity_path == "/world/map"
        for batch in [chunk.to_record_batch()]
        for row in range(batch.num_rows)
    ]
    assert len(shown) > 1
    expected = written(tmp_path / "run" / "map.ply")
    np.testing.assert_allclose(np.sort(np.stack(list(shown[-1])), axis=0), np.sort(expected, axis=0), atol=1e-4)


def test_views_have_the_numbers_of_their_scans(scans):
    """Also after a scan that shows nothing."""
    given = [scan.select(np.arange(0)) if 20 <= number < 25 else scan for number, scan in enumerate(scans)]
    odometry, localiser = ExternalOdometry(truth()), OdometryAlone(ConsistencyCheck())
    pipeline = Pipeline(odometry, localiser, GlobalMapConfig(voxel_size_m=0.1))
    results = list(pipeline.run(given))
    poses = np.array([result.T_world_lidar for result in results])
    numbers = pipeline.map.views.state()["_numbers"]
    assert numbers[:2].tolist() == [0, 2]
    assert not set(numbers) & set(range(20, 25))
    placed = pipeline.map.views.placed(poses)
    np.testing.assert_array_equal(placed.T_world_lidar, poses[numbers])
    # The image is that of the scan with this number: nearest ranges, a fraction of a voxel apart.
    last = int(numbers[-1])
    nearest = np.linalg.norm(results[last].points, axis=1).min()
    assert placed.images[-1][placed.images[-1] > 0.0].min() == pytest.approx(nearest, rel=1e-3)


@pytest.mark.long
def test_moved_points_are_removed_again_with_other_settings(source, tmp_path):
    run(source, tmp_path / "run")
    kept = {}
    for views in (0, 3, 1000):
        out = tmp_path / f"{views}.ply"
        succeeds("map", tmp_path / "run", "--out", out, "--moved", views)
        kept[views] = len(of_person(written(out)))
    assert kept[0] == kept[1000] > 300
    assert kept[3] < 0.2 * kept[0]
