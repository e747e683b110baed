"""Evaluation from files to figures: runs, recordings, trajectory files, maps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.assessment.evaluate import EvaluateRequest, evaluate, format_evaluation
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.core.trajectory import Trajectory, format_kitti, read_transform
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud

from ..conftest import write_run

# Where the run's world lies in the recording's.
T_TRUTH_RUN = exp([0.0, 0.0, 2.0, 5.0, -3.0, 0.5])
STAMPS = 0.1 * np.arange(60)
T = exp(np.multiply.outer(STAMPS, [0.0, 0.0, 0.2, 1.0, 0.1, 0.0]))


@pytest.fixture
def surfaces(rng: np.random.Generator) -> FloatArray:
    """The floor and two walls of a hall."""
    u, v = rng.uniform(0.0, 1.0, (2, 5_000)) * [[20.0], [12.0]]
    nought = np.zeros(len(u))
    walls = [np.stack(c, axis=1) for c in ((u, v, nought), (u, nought, v / 4.0), (nought, v, u / 7.0))]
    return np.concatenate(walls)


@pytest.fixture
def recording(tmp_path: Path, surfaces: FloatArray) -> Path:
    """What a simulated recording of two scans leaves: scans, truth, map and README."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for number in range(2):
        np.save(folder / f"scan_{number}.npy", np.ones((100, 3)))
    Trajectory(STAMPS, T_TRUTH_RUN @ T).save(folder / "ground_truth.tum")
    write_cloud(folder / "map.ply", PointCloud(surfaces, np.zeros_like(surfaces)))
    (folder / "README.md").write_text("Made by `lidarslam simulate` (version 0)")
    return folder


@pytest.fixture
def run(tmp_path: Path, recording: Path, surfaces: FloatArray) -> Path:
    """A run without error but for its map, of which every point is 3 cm too high."""
    points = transform_points(inverse(T_TRUTH_RUN), surfaces + np.array([0.0, 0.0, 0.03]))
    cloud = PointCloud(points, np.zeros_like(points))
    folder = write_run(tmp_path / "run", Trajectory(STAMPS, T), cloud, source=str(recording))
    (folder / "trajectory.kitti").write_text(format_kitti(T))
    (folder / "metrics.json").write_text("{}")
    return folder


def test_a_simulated_recording_brings_truth_and_map(run, recording):
    evaluation = evaluate(EvaluateRequest(run, refine=False))
    written = json.loads((run / "metrics.json").read_text())
    assert written["association"] == {"matched": 60, "estimate": 60, "reference": 60}
    assert written["trajectory"]["ate_rmse_m"] < 1e-6
    assert written["map"]["accuracy_mean_m"] == pytest.approx(0.02, abs=0.011)
    assert written["map"]["coverage_percent"] == {"1.0": 100.0}
    assert set(written["map"]) >= {"completeness_mean_m", "chamfer_m", "f_score_percent", "deviation_percent"}
    assert written["map_alignment"]["method"] == "trajectory"
    np.testing.assert_allclose(written["map_alignment"]["T_reference_map"], T_TRUTH_RUN, atol=1e-6)
    assert written["map_entropy"]["mean_map_entropy"] == written["map"]["mean_map_entropy"]
    text = format_evaluation(evaluation)
    for words in (f"the ground truth of {recording}", "60 of 60", "the exact map of the simulation", "not refined"):
        assert words in text
    assert f"written to {run / 'metrics.json'}" in text
    refined = evaluate(EvaluateRequest(run))
    assert refined.map.alignment.moved_m == pytest.approx(0.03, abs=0.01)
    assert refined.map.json["chamfer_m"] < evaluation.map.json["chamfer_m"]
    assert "ICP, which moved it by 0.03" in format_evaluation(refined)


@pytest.mark.parametrize("alignment", ["trajectory", "none", "FILE"])
def test_every_alignment_is_told(run, tmp_path, alignment):
    np.savetxt(tmp_path / "T.txt", T_TRUTH_RUN)
    chosen = str(tmp_path / "T.txt") if alignment == "FILE" else alignment
    evaluation = evaluate(EvaluateRequest(run, map_alignment=chosen))
    found = evaluation.map.alignment
    assert found.method == ("file" if alignment == "FILE" else alignment)
    assert found.refined == (alignment != "none")
    if alignment == "none":  # wrong here: said in figures and in words
        assert not found.is_trustworthy
        assert any("misaligned" in note for note in evaluation.notes)
    else:
        assert evaluation.map.json["accuracy_mean_m"] < 0.02


@pytest.mark.long
def test_the_map_alone_of_a_run_without_truth(run, recording, surfaces):
    write_cloud(run.parent / "site.ply", PointCloud(surfaces, np.zeros_like(surfaces)))
    (recording / "ground_truth.tum").unlink()
    (recording / "map.ply").unlink()
    evaluation = evaluate(EvaluateRequest(run, reference_map=run.parent / "site.ply"))
    written = json.loads((run / "metrics.json").read_text())
    assert written["association"] is written["trajectory"] is written["kitti"] is None
    assert written["map"]["accuracy_mean_m"] < 0.02
    assert written["map_alignment"]["method"] == "global"
    assert any("the trajectory is not evaluated" in note for note in evaluation.notes)


def test_nothing_to_compare_with(run, recording):
    (recording / "ground_truth.tum").unlink()
    with pytest.raises(InputError, match="came with no ground truth; name a trajectory with --reference"):
        evaluate(EvaluateRequest(run))
    assert evaluate(EvaluateRequest(run, needs_reference=False)).map is None
    recording.rename(recording.with_name("elsewhere"))
    with pytest.raises(InputError, match=r"is not there any more; .* --reference"):
        evaluate(EvaluateRequest(run))
    evaluation = evaluate(EvaluateRequest(run, needs_reference=False))
    assert evaluation.entropy is not None
    assert json.loads((run / "metrics.json").read_text())["map"] is None
    assert "mean map entropy" in format_evaluation(evaluation)


@pytest.mark.parametrize("name", ["truth.tum", "truth.kitti", "folder", "run"])
def test_references_of_every_kind(run, recording, tmp_path, name):
    Trajectory(STAMPS, T).save(tmp_path / "truth.tum")
    (tmp_path / "truth.kitti").write_text(format_kitti(T))
    reference = {"folder": recording, "run": run}.get(name, tmp_path / name)
    evaluation = evaluate(EvaluateRequest(run, reference=reference, out=tmp_path / "figures.json"))
    assert evaluation.metrics.errors.ate_rmse_m < 1e-6
    assert json.loads((tmp_path / "figures.json").read_text())["association"]["matched"] == 60
    assert (run / "metrics.json").read_text() == "{}"


def test_kitti_files_are_matched_by_number(tmp_path):
    (tmp_path / "a.txt").write_text(format_kitti(T))
    (tmp_path / "b.txt").write_text(format_kitti(T[:-1]))
    evaluation = evaluate(EvaluateRequest(tmp_path / "a.txt", reference=tmp_path / "a.txt"))
    assert evaluation.written == []
    with pytest.raises(InputError, match=r"a\.txt has 60 poses, .*b\.txt has 59, .* no stamps"):
        evaluate(EvaluateRequest(tmp_path / "a.txt", reference=tmp_path / "b.txt"))


def test_a_kitti_estimate_meets_the_truth_in_the_cameras_frame(tmp_path):
    folder = tmp_path / "sequences" / "00"
    (folder / "velodyne").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    for number in range(2):
        np.ones((100, 4), dtype=np.float32).tofile(folder / "velodyne" / f"{number:06d}.bin")
    poses = exp(np.multiply.outer(np.arange(40.0), [0.0, 0.05, 0.0, 0.0, 0.0, 1.0]))
    (tmp_path / "poses" / "00.txt").write_text(format_kitti(poses))
    Tr = "0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3"
    (folder / "calib.txt").write_text("".join(f"P{n}: 1 0 0 0 0 1 0 0 0 0 1 0\n" for n in range(4)) + f"Tr: {Tr}\n")
    (tmp_path / "estimate.txt").write_text(format_kitti(poses))
    evaluation = evaluate(EvaluateRequest(tmp_path / "estimate.txt", reference=folder))
    assert evaluation.metrics.errors.ate_rmse_m < 1e-6
    assert evaluation.metrics.errors.rpe_translation_rmse_m < 1e-6


def test_errors_are_written_as_coloured_points(run, tmp_path):
    ply, rrd = tmp_path / "errors.ply", tmp_path / "errors.rrd"
    evaluation = evaluate(EvaluateRequest(run, errors=[ply, rrd], refine=False))
    vertices = read_ply(ply)
    np.testing.assert_allclose(vertices["distance_m"], evaluation.map.comparison.map_errors.distances_m, rtol=1e-6)
    assert vertices.dtype["x"] == np.float64
    from rerun.chunk import RrdReader

    entities = {chunk.entity_path for chunk in RrdReader(rrd).stream()}
    assert {"/world/map_to_reference", "/world/reference_to_map", "/world/path", "/legend"} <= entities


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"errors": "x.txt"}, OutputError, r"\.ply or \.rrd"),
        ({"errors": "none/x.ply"}, OutputError, "there is no folder"),
        ({"reference_map": "none.ply"}, InputError, "no such file"),
        ({"reference": "none.tum"}, InputError, "no such file"),
        ({"run": "recording"}, InputError, "not a run directory"),
        ({"map_file": "recording/README.md"}, InputError, "not a point cloud"),
    ],
)
def test_mistakes_are_named(run, tmp_path, change, kind, message):
    places: dict[str, Any] = {key: tmp_path / name for key, name in change.items()}
    if "errors" in places:
        places["errors"] = [places["errors"]]
    with pytest.raises(kind, match=message):
        evaluate(EvaluateRequest(**{"run": run} | places))
    assert (run / "metrics.json").read_text() == "{}"


def test_a_global_search_needs_icp():
    with pytest.raises(ConfigError, match="let --refine follow it"):
        EvaluateRequest(Path(), map_alignment="global", refine=False)


@pytest.mark.parametrize("spoil", [lambda T: T[:3], lambda T: 2.0 * T, lambda T: T[:, :3]])
def test_a_file_that_is_no_pose(tmp_path, spoil):
    np.savetxt(tmp_path / "T.txt", T_TRUTH_RUN)
    np.testing.assert_allclose(read_transform(tmp_path / "T.txt"), T_TRUTH_RUN, atol=1e-12)
    np.savetxt(tmp_path / "T.txt", spoil(T_TRUTH_RUN))
    with pytest.raises(InputError, match=r"T\.txt"):
        read_transform(tmp_path / "T.txt")
