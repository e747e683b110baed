"""The Apollo reader on scans and poses in the layout that KISS-ICP reads too."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import choose_reader, open_recording

from ..conftest import pcd_bytes, point_table

START = 1_530_000_000.0
SCANS = 12


def _T_world_lidar(index: ArrayLike) -> np.ndarray:
    return exp([0.0, 0.0, 2.0, 10.0, -20.0, 3.0]) @ exp(np.multiply.outer(index, [0.0, 0.0, 0.05, 1.0, 0.0, 0.0]))


@pytest.fixture
def area(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Two sequences of one area; scans are counted from 1 on, without leading zeros."""
    for name in ("MathildaAVE-1", "SanJoseDowntown-2"):
        folder = tmp_path / "TrainData" / name
        (folder / "pcds").mkdir(parents=True)
        (folder / "poses").mkdir()
        lines = []
        for index in range(1, SCANS + 1):
            table = point_table(rng.uniform(-30.0, 30.0, (20, 3)), intensity=np.full(20, index, "<f4"))
            (folder / "pcds" / f"{index}.pcd").write_bytes(pcd_bytes(table))
            T = _T_world_lidar(index)
            numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
            lines.append(f"{index} {START + 0.1 * index:.6f} {' '.join(f'{number:.9f}' for number in numbers)}\n")
        (folder / "poses" / "gt_poses.txt").write_text("".join(lines))
    return tmp_path / "TrainData"


def test_scans_and_poses_in_the_order_of_numbers(area: Path) -> None:
    assert choose_reader(area) == choose_reader(area / "MathildaAVE-1") == "apollo"
    recording = open_recording(area, ReaderConfig(sequence="SanJoseDowntown-2"))
    assert recording.name == "SanJoseDowntown-2"
    scans = list(recording.scans())
    numbers = np.arange(1, SCANS + 1)
    assert [scan.intensities[0] for scan in scans] == numbers.tolist()
    assert [scan.stamp for scan in scans] == pytest.approx(START + 0.1 * numbers)
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar, _T_world_lidar(numbers), atol=1e-8)


def test_poses_by_index_where_scans_are_missing(area: Path) -> None:
    folder = area / "MathildaAVE-1"
    (folder / "pcds" / "1.pcd").unlink()
    recording = open_recording(folder)
    assert len(recording) == len(recording.ground_truth) == SCANS - 1
    assert next(recording.scans()).stamp == pytest.approx(START + 0.2)


def test_poses_that_do_not_go_with_the_scans(area: Path) -> None:
    poses = area / "MathildaAVE-1" / "poses" / "gt_poses.txt"
    lines = poses.read_text().splitlines(keepends=True)
    poses.write_text("".join(lines[:-1]))
    with pytest.raises(InputError, match="expected a line for each of the 12 scans, by its index or in their order"):
        open_recording(area / "MathildaAVE-1")
