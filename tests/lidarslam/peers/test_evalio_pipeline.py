"""lidarslam as a pipeline of evalio, run by evalio itself on a dataset of one's own."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.geometry import exp, inverse, log, make_transform

pytest.importorskip("evalio", reason="needs the extra peers")

REPOSITORY = Path(__file__).parents[3]
DATASET = """
from pathlib import Path
import numpy as np
from evalio.datasets import Dataset, DatasetIterator, register_dataset
from evalio.types import SE3, Duration, ImuParams, LidarMeasurement, LidarParams, Point, Stamp

FILES = sorted(Path(__file__).parent.glob("*.npz"))

class Files(DatasetIterator):
    def imu_iter(self):
        return iter(())
    def lidar_iter(self):
        for file in FILES:
            with np.load(file) as data:
                rows = zip(data["points"].tolist(), data["times"].tolist())
                points = [Point(x=x, y=y, z=z, t=Duration.from_sec(t)) for (x, y, z), t in rows]
                yield LidarMeasurement(Stamp.from_sec(float(data["start"])), points)
    def __iter__(self):
        return self.lidar_iter()
    def __len__(self):
        return len(FILES)

class Room(Dataset):
    box = "box"
    def data_iter(self):
        return Files()
    def imu_T_lidar(self):
        return SE3.from_mat(np.load(Path(__file__).parent / "imu_T_lidar.npy"))
    def imu_T_gt(self):
        return SE3.identity()
    def imu_params(self):
        return ImuParams()
    def lidar_params(self):
        return LidarParams(num_rows=16, num_columns=512, min_range=0.1, max_range=100.0)
    def files(self):
        return []
    def is_downloaded(self):
        return True
    @staticmethod
    def url():
        return "none"
    def quick_len(self):
        return len(FILES)
"""


@pytest.mark.long
def test_evalio_runs_it_and_saves_the_imus_poses_at_the_starts_of_the_sweeps(tmp_path, room_scans, room_truth):
    (tmp_path / "room_dataset.py").write_text(DATASET)
    T_imu_lidar = make_transform(exp([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])[:3, :3], [0.2, 0.0, 0.1])
    np.save(tmp_path / "imu_T_lidar.npy", T_imu_lidar)
    starts = []
    for index, scan in enumerate(room_scans[:6]):
        first = float(scan.time_offsets.min())
        starts.append(scan.stamp + first)
        times = scan.time_offsets - first
        np.savez(tmp_path / f"{index}.npz", points=scan.points, times=times, start=scan.stamp + first)
    arguments = ["run", "-d", "room/box", "-p", "lidarslam", "-o", "results"]
    done = subprocess.run(
        [sys.executable, "-m", "lidarslam.api.evalio_pipeline", *arguments],
        cwd=tmp_path,
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(REPOSITORY)]), "EVALIO_CUSTOM": "room_dataset"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    saved = list((tmp_path / "results").rglob("lidarslam.csv"))
    assert saved, done.stdout + done.stderr
    rows = np.array([line.split(",") for line in saved[0].read_text().splitlines() if line[:1].isdigit()], dtype=float)
    np.testing.assert_allclose(rows[:, 0], starts, atol=1e-6)
    moved = np.linalg.norm(rows[-1, 1:4] - rows[0, 1:4])
    ends = room_truth.T_world_lidar[[0, 5]] @ inverse(T_imu_lidar)
    assert moved == pytest.approx(np.linalg.norm(log(inverse(ends[0]) @ ends[1])[3:]), abs=0.03)
