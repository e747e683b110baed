"""Several recordings of one simulated office become one map; one of another office does not."""

import json
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import read_tum
from lidarslam.merge.merge import MergeOutcome, MergeRequest, format_merge, merge
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.run.run import Progress
from lidarslam.simulation.motion import Motion
from lidarslam.simulation.record import RecordRequest, make_simulation
from lidarslam.storage.directory import FILES
from lidarslam.storage.finished_run import load_map, load_run

from ..conftest import write_recording
from .conftest import quiet

SETTINGS = ["global_map.voxel_size_m=0.1"]
PARTS = ("01_first", "02_foreign", "03_second")


@dataclass(frozen=True, eq=False)
class Later(Motion):
    """A motion that one comes to later."""

    since_s: float = 0.0

    def pose_at(self, times: FloatArray) -> FloatArray:
        return super().pose_at(times + self.since_s)


def record(folder: Path, office: int, since_s: float, scans: int, noise: int) -> Path:
    """Part of a walk through an office with a VLP-16, as .npy scans with times, stamps and ground truth."""
    walk = make_simulation(RecordRequest(folder, "office", "vlp-16", "handheld", "upright", scans, office, ""))
    motion = Later(**{f.name: getattr(walk.motion, f.name) for f in fields(Motion)}, since_s=since_s)
    simulation = replace(walk, motion=motion, seed=noise)
    return write_recording(folder, simulation.scans(), simulation.ground_truth, is_timed=True)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two walks that share some metres, and one in another office."""
    root = tmp_path_factory.mktemp("recordings")
    walks = {"first": (0, 2.5, 90, 0), "second": (0, 5.0, 75, 1), "foreign": (5, 3.5, 12, 2)}
    return {name: record(root / name, *walk) for name, walk in walks.items()}


def request(out: Path, *sources: Path, settings: tuple[str, ...] = (), **more: Any) -> MergeRequest:
    return MergeRequest(sources, out, load_config(None, [*SETTINGS, *settings]), **more)


@pytest.fixture(scope="module")
def merged(places: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MergeOutcome]:
    out = tmp_path_factory.mktemp("merged") / "office"
    return out, merge(request(out, places["first"], places["foreign"], places["second"]), quiet)


@pytest.mark.long
def test_all_that_find_one_another_are_in_the_frame_of_the_first(merged, places):
    out, outcome = merged
    assert [recording.joined for recording in outcome.recordings] == [True, False, True]
    T_office_common = read_tum(places["first"] / "ground_truth.tum").T_world_lidar[0]
    shifts = []
    for name, place in (("01_first", "first"), ("03_second", "second")):
        estimate, truth = read_tum(out / name / "trajectory.tum"), read_tum(places[place] / "ground_truth.tum")
        wrong_m = transform_points(T_office_common, estimate.positions) - truth.at(estimate.stamps)[:, :3, 3]
        # The first scan of all, as noisy as any, is where the frame comes from: 0.2 degrees are 5 cm at the other end.
        assert np.linalg.norm(wrong_m, axis=1).max() < 0.1
        shifts.append(wrong_m.mean(axis=0))
    assert np.linalg.norm(shifts[1] - shifts[0]) < 0.03  # beside one another they lie better than in that frame
    moved = read_tum(out / "03_second" / "trajectory.tum").positions[0]
    assert np.linalg.norm(moved) > 1.0  # which is where it began for itself
    apart = read_tum(out / "02_foreign" / "trajectory.tum").positions[0]
    assert np.linalg.norm(apart) < 0.05


@pytest.mark.long
def test_the_common_map_holds_what_is_joined_and_nothing_else(merged):
    out, outcome = merged
    common = load_map(out).points
    assert len(common) == outcome.map.points > 0
    first, foreign, second = (load_map(out / name).points for name in PARTS)
    distances = cKDTree(np.concatenate([first, second])).query(common)[0]
    assert np.quantile(distances, 0.999) < 0.1  # a voxel
    assert distances.max() < 0.5  # what moved is left out of each map by its own scans
    tree = cKDTree(common)
    assert np.percentile(tree.query(first)[0], 99.0) < 0.1
    assert np.percentile(tree.query(second)[0], 99.0) < 0.1
    assert np.median(tree.query(foreign)[0]) > 0.1
    assert np.median(cKDTree(first).query(second)[0]) < 0.06, "walls that both saw are one wall"


@pytest.mark.long
def test_the_summary_tells_who_is_joined_by_what(merged, places):
    out, outcome = merged
    summary = json.loads((out / "summary.json").read_text())
    given = [places[name] for name in ("first", "foreign", "second")]
    told = [tuple(entry[key] for key in ("directory", "scans", "source")) for entry in summary["recordings"]]
    assert told == list(zip(PARTS, (90, 12, 75), [str(place.resolve()) for place in given], strict=True))
    accepted = [loop for loop in summary["pose_graph"]["loops"] if loop["accepted"]]
    assert len(accepted) == summary["loop_closures"] >= 3
    assert {(loop["first_recording"], loop["second_recording"]) for loop in accepted} == {(1, 3)}
    truths = [read_tum(place / "ground_truth.tum").T_world_lidar for place in given]
    for loop in accepted:  # scans are counted within their recordings
        first = truths[loop["first_recording"] - 1][loop["first_scan"]]
        second = truths[loop["second_recording"] - 1][loop["second_scan"]]
        assert np.linalg.norm((inverse(first) @ second)[:3, 3]) == pytest.approx(loop["distance_m"], abs=0.1)
    graph = summary["pose_graph"]
    assert graph_keys(out) == (list(range(graph["keyframes"])), graph["edges"])
    (apart,) = (warning for warning in summary["warnings"] if "left out of the common map" in warning)
    assert apart.startswith("02_foreign: ")
    assert load_config(out / "config.yaml").pose_graph.enabled
    text = format_merge(out, outcome)
    assert "2 of 3 recordings in one map" in text
    assert f"{len(accepted)} between recordings, 0 within" in text
    assert "02_foreign: 12 scans" in text


@pytest.mark.slow
def test_recordings_of_a_sensor_on_its_side_are_merged_as_upright_ones(merged, places, tmp_path):
    for place in places.values():
        turned = tmp_path / place.name
        turned.mkdir()
        for path in sorted(place.glob("*.npy")):
            table = np.load(path)
            table["y"], table["z"] = -table["z"], table["y"].copy()
            np.save(turned / path.name, table)
        (turned / "timestamps.txt").write_bytes((place / "timestamps.txt").read_bytes())
    sources = [tmp_path / name for name in ("first", "foreign", "second")]
    outcome = merge(request(tmp_path / "merged", *sources, settings=("reader.mounting=left",)), quiet)
    assert [recording.joined for recording in outcome.recordings] == [True, False, True]
    np.testing.assert_allclose(load_map(tmp_path / "merged").points, load_map(merged[0]).points)
    for name in PARTS:
        found, expected = (load_run(out / name) for out in (tmp_path / "merged", merged[0]))
        np.testing.assert_allclose(found.map_points, expected.map_points)
        np.testing.assert_allclose(found.trajectory.T_world_lidar, expected.trajectory.T_world_lidar, atol=1e-6)


def graph_keys(out: Path) -> tuple[list[int], int]:
    """Keys of the poses of a pose graph, and how many edges it has."""
    words = [line.split() for line in (out / "pose_graph.g2o").read_text().splitlines()]
    return [int(key) for tag, key, *_ in words if tag == "VERTEX_SE3:QUAT"], sum(w[0] == "EDGE_SE3:QUAT" for w in words)


@pytest.mark.long
def test_each_recording_has_a_run_of_its_own(merged):
    out, _ = merged
    keyframes = []
    for name, scans in zip(PARTS, (90, 12, 75), strict=True):
        run = load_run(out / name)
        assert (len(run.trajectory), len(run.map_points) > 0) == (scans, True)
        summary = json.loads((out / name / "summary.json").read_text())
        assert summary["loop_closures"] == 0  # none leads back within so short a way
        assert summary["map_voxel_size_m"] == 0.1
        assert any("frame of its own" in warning for warning in summary["warnings"]) == (name == "02_foreign")
        poses, _ = graph_keys(out / name)
        assert poses == list(range(summary["pose_graph"]["keyframes"]))
        keyframes.append(len(poses))
        assert json.loads((out / name / "metrics.json").read_text())["trajectory"]["ate_rmse_m"] < 0.035
        odometry = read_tum(out / name / "odometry.tum").positions[0]
        assert np.linalg.norm(odometry) < 0.05  # as it was, in a frame of its own
    assert keyframes[0] + keyframes[2] == len(graph_keys(out)[0])


# What follows is about files and errors; the rooms are too small to be joined.
FAST = ("odometry.method=constant-velocity", "checkpoints.every_scans=1")


@pytest.fixture
def rooms(tmp_path: Path, room_scans: list[Scan]) -> list[Path]:
    return [write_recording(tmp_path / f"in room {number}", room_scans[:5]) for number in range(3)]


def folders(out: Path) -> list[str]:
    return sorted(path.name for path in out.iterdir() if path.is_dir())


@pytest.mark.long
def test_an_earlier_merge_is_replaced_only_when_asked(rooms, tmp_path):
    out = tmp_path / "out"
    merge(request(out, *rooms, settings=FAST), quiet)
    assert folders(out) == ["01_in_room_0", "02_in_room_1", "03_in_room_2"]
    (out / "03_in_room_2" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        merge(request(out, *rooms[:2], settings=FAST), quiet)
    merge(request(out, *rooms[1:], overwrite=True, settings=FAST), quiet)
    assert folders(out) == ["01_in_room_1", "02_in_room_2", "03_in_room_2"]
    assert [path.name for path in (out / "03_in_room_2").iterdir()] == ["notes.txt"]
    assert not list(out.rglob(".partial*"))


@pytest.mark.long
def test_damaged_scans_are_left_out_and_a_recording_without_any_is_told(rooms, tmp_path):
    (rooms[0] / "000003.npy").write_bytes(b"not an array")
    for scan in rooms[1].glob("*.npy"):
        scan.write_bytes(b"not an array")
    outcome = merge(request(tmp_path / "out", *rooms, settings=FAST), quiet)
    assert [recording.scans for recording in outcome.recordings] == [4, 0, 5]
    assert [recording.directory for recording in outcome.recordings] == ["01_in_room_0", None, "03_in_room_2"]
    assert not (tmp_path / "out" / "02_in_room_1").exists()
    (stopped,) = outcome.stopped
    assert "no scan could be used: 5 scans were left out: not readable" in stopped
    assert any("1 scan was left out: not readable" in warning for warning in outcome.warnings)
    assert len(read_tum(tmp_path / "out" / "03_in_room_2" / "trajectory.tum")) == 5


@pytest.mark.long
def test_an_interrupted_merge_goes_on_where_it_was(rooms, tmp_path, timeless):
    """Neither the recording that was tracked is tracked again, nor the scans before the last checkpoint."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    merge(request(whole, *rooms, settings=FAST), quiet)
    seen: list[tuple[str, int]] = []

    @contextmanager
    def interrupt(name: str) -> Iterator[Progress]:
        def tell(number: int, _total: int, _result: ScanEstimate) -> None:
            seen.append((name[:2], number))
            if ("1/", 5) in seen and seen[-1] == ("2/", 3):  # not when it is resumed
                raise KeyboardInterrupt

        yield tell

    outcome = merge(request(out, *rooms, settings=FAST), interrupt)
    assert [recording.scans for recording in outcome.recordings] == [5, 3, 0]
    assert len(load_run(out / "02_in_room_1").trajectory) == 3  # the results so far are accepted
    seen.clear()
    with pytest.raises(InputError, match=r"was begun with global_map\.max_range_m .* \(now 7\.0\)"):
        merge(request(out, *rooms, settings=(*FAST, "global_map.max_range_m=7"), resume=True), interrupt)
    outcome = merge(request(out, *rooms, settings=FAST, resume=True), interrupt)
    assert outcome.stopped == ()
    assert {name for name, _ in seen} == {"2/", "3/"}
    assert min(number for name, number in seen if name == "2/") > 1
    assert timeless(out) == timeless(whole)
    with pytest.raises(InputError, match="holds no run to resume"):
        merge(request(out, *rooms, settings=FAST, resume=True), quiet)


@pytest.mark.slow
def test_a_killed_merge_is_refused_and_resumed_or_made_again(rooms, tmp_path, killable, timeless):
    """Killed as it begins, halfway and among its results, it leaves no run and no map."""
    rooms = rooms[:2]
    whole, command = tmp_path / "whole", ["merge", *rooms]
    command += [argument for setting in (*SETTINGS, *FAST) for argument in ("--set", setting)]
    things = killable(*command, out=whole).events
    assert (whole / "map.ply").is_file(), "the merge that was not killed ended before its results"
    kills = [round(share * things) for share in (0.2, 0.5, 0.75)]
    for kill_at in kills:
        out = tmp_path / "killed" / str(kill_at)
        assert killable(*command, out=out, kill_at=kill_at).status == -signal.SIGKILL
        again = f"this merge did not finish; resume it with lidarslam merge {rooms[0]} {rooms[1]} --out {out} --resume"
        with pytest.raises(InputError, match=re.escape(again)):
            load_map(out)
        for part in out.glob("0*"):
            if (part / "unfinished" / "run.json").exists():
                with pytest.raises(InputError, match=re.escape(again)):
                    load_run(part)
            elif any((part / name).exists() for name in FILES):  # all was written, and only that was not said yet
                assert len(load_run(part).trajectory) == 5
        with pytest.raises(OutputError, match=re.escape(again)):
            merge(request(out, *rooms, settings=FAST), quiet)
        if kill_at != kills[1]:
            merge(request(out, *rooms, resume=True, settings=FAST), quiet)
            assert timeless(out) == timeless(whole)
    reversed_out = tmp_path / "killed" / str(kills[1])
    merge(request(reversed_out, *rooms[::-1], overwrite=True, settings=FAST), quiet)
    assert not list(reversed_out.rglob("unfinished"))
    assert folders(reversed_out) == ["01_in_room_1", "02_in_room_0"]


@pytest.mark.long
def test_what_cannot_be_merged_is_said_before_anything_is_written(rooms, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(OutputError, match="is the recording itself"):
        merge(request(rooms[1], *rooms, overwrite=True), quiet)
    with pytest.raises(ConfigError, match="external"):
        merge(request(out, *rooms, settings=("odometry.method=external",)), quiet)
    with pytest.raises(InputError, match="no such"):
        merge(request(out, rooms[0], tmp_path / "nothing"), quiet)
    for scan in (path for room in rooms for path in room.glob("*.npy")):
        scan.write_bytes(b"not an array")
    with pytest.raises(InputError, match="no scan of any recording"):
        merge(request(out, *rooms, settings=FAST), quiet)
    assert not out.exists()
    assert sorted(path.name for path in rooms[1].iterdir())[-1] == "timestamps.txt"
