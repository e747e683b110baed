"""A run whose map contradicts itself says so, whatever its scans' statuses are."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from lidarslam.compare.method_run import Ending, Limits, judge
from lidarslam.core.geometry import inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, write_tum
from lidarslam.evaluation.map.entropy import map_entropy, sampled_map_entropy

from ..conftest import lidarslam, write_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan]) -> Path:
    """Twenty scans of a room, compensated."""
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", room_scans)


def run(recording: Path, truth: Trajectory, out: Path, scale: float, *more: str) -> tuple[Result, dict[str, Any]]:
    """A run on the true motion, its translation scaled; and the summary."""
    motions = inverse(truth.T_world_lidar[:-1]) @ truth.T_world_lidar[1:]
    motions[:, :3, 3] *= scale
    poses = [np.eye(4)]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    prior = out.parent / f"{scale}.tum"
    write_tum(prior, Trajectory(truth.stamps, np.array(poses)))
    result = lidarslam("run", recording, "--out", out, "--prior", prior, "--no-mapping", *more)
    return result, json.loads((out / "summary.json").read_text(encoding="utf-8"))


@pytest.mark.long
def test_a_slide_is_a_warning_and_exit_status_3(tmp_path: Path, recording: Path, room_truth: Trajectory) -> None:
    good, fine = run(recording, room_truth, tmp_path / "good", 1.0)
    assert good.exit_code == 0, good.output
    assert fine["map_contradictions"] == []
    assert not any("contradicts itself" in warning for warning in fine["warnings"])
    assert "mean map entropy" in good.output
    slid, summary = run(recording, room_truth, tmp_path / "slid", 0.4)
    assert slid.exit_code == 3, slid.output
    assert summary["lost_scans"] == 0
    assert summary["map_contradictions"][0]["shift_m"] > 0.2
    assert any("contradicts itself" in warning for warning in summary["warnings"])
    assert "the map contradicts itself between scans 0 and" in slid.output
    assert summary["map_entropy"] > fine["map_entropy"]
    ended = judge(Ending("itself", 3, 1.0, None), tmp_path / "slid", tmp_path / "no.log", Limits())
    last = summary["map_contradictions"][0]["last"]
    assert ended == ("lost", f"its map contradicts itself between scans 0 and {last}")
    again, _ = run(recording, room_truth, tmp_path / "slid", 0.4, "--resume")
    assert again.exit_code == 3
    assert "is finished already" in again.output


def test_a_large_map_is_sampled_by_blocks_and_no_map_has_no_entropy(rng: np.random.Generator) -> None:
    ground = rng.uniform(-60.0, 60.0, (400_000, 3)) * [1.0, 1.0, 0.0005]
    part = sampled_map_entropy(ground, 100_000)
    assert part is not None
    assert 2_000 < part.points <= 10_000
    one, other = sampled_map_entropy(ground), map_entropy(ground, most_samples=10_000)
    assert one is not None
    assert one == other
    assert part.mean == pytest.approx(one.mean, abs=0.1)
    assert sampled_map_entropy(np.empty((0, 3))) is None
