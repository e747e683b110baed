"""Meshes of a map of known surfaces, and their files."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes
from lidarslam.core.trajectory import Trajectory, write_tum
from lidarslam.mapping.global_map.edits import reconstruct
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud

from ..conftest import lidarslam, succeeds

RADIUS_M = 3.0


@pytest.fixture(scope="module")
def bowl() -> PointCloud:
    """The lower half of a sphere, seen from its inside, red on one side."""
    rng = np.random.default_rng(3)
    outwards = rng.normal(size=(20_000, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    outwards = outwards[outwards[:, 2] < 0.0]
    rgb = np.where(outwards[:, :1] > 0.0, np.array([255, 0, 0]), np.array([0, 0, 255])).astype(np.uint8)
    return PointCloud(RADIUS_M * outwards, -outwards, PointAttributes(rgb=rgb))


def distances(vertices: FloatArray) -> FloatArray:
    return np.abs(np.linalg.norm(vertices, axis=1) - RADIUS_M)


def test_the_surface_is_the_one_that_was_measured(bowl):
    mesh = reconstruct(bowl, 0.15)
    inner = mesh.vertices[:, 2] < -0.3  # at the rim the surface goes on, for the edge of a cell
    assert distances(mesh.vertices[inner]).max() < 0.05
    assert distances(mesh.vertices).max() < 0.15
    assert distances(mesh.vertices).mean() < 0.01
    assert mesh.vertices[:, 2].max() < 0.2  # not closed over the top
    corners = mesh.vertices[mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert area == pytest.approx(2.0 * np.pi * RADIUS_M**2, rel=0.1)
    assert (mesh.colours[mesh.vertices[:, 0] > 0.3, 0] == 255).all()
    assert (mesh.colours[mesh.vertices[:, 0] < -0.3, 2] == 255).all()


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_the_files_are_read_by_others(bowl, tmp_path, suffix):
    import open3d as o3d

    run, out = tmp_path / "run", tmp_path / f"mesh{suffix}"
    run.mkdir()
    write_tum(run / "trajectory.tum", Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))))
    write_cloud(run / "map.ply", bowl)
    command = ["export-mesh", str(run), "--out", str(out), "--cell", "0.3"]
    succeeds(*command)
    mesh = o3d.io.read_triangle_mesh(str(out))
    assert len(mesh.triangles) > 500
    assert distances(np.asarray(mesh.vertices)).max() < 0.3
    colours = np.asarray(mesh.vertex_colors)
    assert suffix in (".obj", ".stl") or (len(colours) and set(np.unique(colours)) == {0.0, 1.0})
    assert lidarslam(*command).exit_code == 1
    assert lidarslam("export-mesh", run, "--out", "mesh.off").exit_code == 2
