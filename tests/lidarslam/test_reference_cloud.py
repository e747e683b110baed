"""Clouds of every format, with the coordinates of a survey."""

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest

from lidarslam.assessment.inputs import read_cloud
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray

UTM = np.array([5e5, 5e6, 300.0])


@pytest.fixture
def survey(rng: np.random.Generator) -> FloatArray:
    """Points around UTM coordinates, whole millimetres."""
    return np.round(rng.uniform(-20.0, 20.0, (500, 3)), 3) + UTM


def _write_las(path: Path, points: FloatArray) -> None:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = UTM, np.full(3, 0.001)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(path)


def _write_e57(path: Path, points: FloatArray) -> None:
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(path), mode="w")
    local = points - UTM
    for half in (local[::2], local[1::2]):
        columns = {f"cartesian{axis}": half[:, column].copy() for column, axis in enumerate("XYZ")}
        file.write_scan_raw(columns, rotation=np.array([1.0, 0.0, 0.0, 0.0]), translation=UTM)
    file.close()


def _write_ply(path: Path, points: FloatArray) -> None:
    o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))


def _write_pcd(path: Path, points: FloatArray) -> None:
    header = f"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    path.write_bytes(f"{header}POINTS {len(points)}\nDATA binary\n".encode() + points.tobytes())


WRITERS: dict[str, Callable[[Path, FloatArray], None]] = {
    "cloud.las": _write_las,
    "cloud.laz": _write_las,
    "cloud.e57": _write_e57,
    "cloud.ply": _write_ply,
    "cloud.PCD": _write_pcd,
}


@pytest.mark.parametrize("name", WRITERS)
def test_large_coordinates_survive(tmp_path, survey, name):
    WRITERS[name](tmp_path / name, survey)
    points = read_cloud(tmp_path / name)
    assert points.dtype == np.float64
    in_order = [cloud[np.lexsort(np.round(cloud, 3).T)] for cloud in (points, survey)]
    np.testing.assert_allclose(*in_order, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("share", [0.02, 0.6])
def test_a_truncated_file_gets_one_line(tmp_path, survey, name, share):
    WRITERS[name](tmp_path / name, survey)
    os.truncate(tmp_path / name, int(share * (tmp_path / name).stat().st_size))
    with pytest.raises(InputError, match=rf"{name}: not a readable") as caught:
        read_cloud(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("at_end", [False, True])
def test_a_laz_file_with_endless_chunks_is_refused(tmp_path, survey, at_end):
    """In a process of its own, which lazrs ends otherwise."""
    _write_las(tmp_path / "cloud.laz", survey)
    content = bytearray((tmp_path / "cloud.laz").read_bytes())
    data = int.from_bytes(content[96:100], "little")
    table = int.from_bytes(content[data : data + 8], "little")
    content[table + 4 : table + 8] = b"\xff" * 4
    if at_end:
        content[data : data + 8] = b"\xff" * 8
        content += table.to_bytes(8, "little")
    (tmp_path / "cloud.laz").write_bytes(content)
    program = f"from {read_cloud.__module__} import *; read_cloud(Path({str(tmp_path / 'cloud.laz')!r}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "cloud.laz: not a readable LAZ file (4,294,967,295 chunks)" in done.stderr


def test_a_header_that_promises_many_points_takes_no_memory(tmp_path, survey):
    _write_las(tmp_path / "cloud.las", survey)
    content = bytearray((tmp_path / "cloud.las").read_bytes())
    content[107:111] = (1 << 25).to_bytes(4, "little")  # of 34 bytes: a gigabyte
    (tmp_path / "cloud.las").write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="not a readable LAS file"):
        read_cloud(tmp_path / "cloud.las")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10


def test_points_that_are_none_are_dropped(tmp_path, survey):
    survey[::5, 1] = np.nan
    _write_pcd(tmp_path / "cloud.pcd", survey)
    assert len(read_cloud(tmp_path / "cloud.pcd")) == 400
    survey[:] = np.inf
    _write_pcd(tmp_path / "cloud.pcd", survey)
    with pytest.raises(InputError, match=r"cloud\.pcd: holds no point"):
        read_cloud(tmp_path / "cloud.pcd")
