"""Occupancy grids and meshes of maps whose surfaces are known, and their files as other programs read them."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.scan import PointAttributes
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.edits import reconstruct
from lidarslam.mapping.global_map.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridOptions,
    OccupancyGrid,
    find_ground,
    occupancy_grid,
)
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage.finished_run import load_map

from ..conftest import lidarslam, succeeds, write_run

SLOPE = np.tan(np.deg2rad(10.0))
SENSOR_M = 1.0
STEP = 0.05


def patch(corner: FloatArray, along: FloatArray, across: FloatArray, spacing: float = 0.04) -> FloatArray:
    """Points (N, 3) of a parallelogram."""
    u = np.arange(0.0, 1.0 + 1e-9, spacing / np.linalg.norm(along))
    v = np.arange(0.0, 1.0 + 1e-9, spacing / np.linalg.norm(across))
    u, v = (each.ravel() for each in np.meshgrid(u, v))
    return corner + np.outer(u, along) + np.outer(v, across)


def at(x: float, y: float, z: float = 0.0) -> FloatArray:
    """A point at a height above the floor, which rises along x."""
    return np.array([x, y, SLOPE * x - SENSOR_M + z])


@pytest.fixture(scope="module")
def room() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points, normals and path of a room of 8 by 6 m on a slope, with a table, a box and a lamp under the ceiling."""
    x, y, up = np.array([1.0, 0.0, SLOPE]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    level = [
        patch(at(-2, -3), 8 * x, 6 * y),  # the floor
        patch(at(-2, -3, 2.5), 8 * x, 6 * y),  # the ceiling
        patch(at(2, 1, 0.7), x, y),  # a table without legs
        patch(at(0.0, -2.5, 2.1), 0.5 * x, 0.5 * y),  # a lamp
    ]
    walls = [
        patch(at(-2, -3), 8 * x, 2.5 * up),
        patch(at(-2, 3), 8 * x, 2.5 * up),
        patch(at(-2, -3), 6 * y, 2.5 * up),
        patch(at(6, -3), 6 * y, 2.5 * up),
        patch(at(4, -2), 0.5 * y, 0.3 * up),  # the face of a box
    ]
    points = np.concatenate([*level, *walls])
    upright = np.arange(len(points)) < sum(map(len, level))
    normals = np.where(upright[:, None], up, np.array([1.0, 0.0, 0.0]))
    path = np.array([at(each, 0.0, SENSOR_M) for each in np.linspace(-1.0, 5.0, 61)])
    return points, normals, path


@pytest.fixture(scope="module")
def grid(room: tuple[FloatArray, FloatArray, FloatArray]) -> OccupancyGrid:
    return occupancy_grid(*room, GridOptions(resolution_m=STEP))


def value(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.origin) / grid.resolution_m).astype(int)
    return int(grid.cells[row, column])


def test_the_ground_follows_the_slope(room):
    ground = find_ground(*room)
    xy = np.random.default_rng(1).uniform([-1.7, -2.7], [5.7, 2.7], (200, 2))
    np.testing.assert_allclose(ground.at(xy), SLOPE * xy[:, 0] - SENSOR_M, atol=0.03)


def test_walls_are_occupied_to_a_cell(grid):
    for along in np.linspace(-1.9, 5.9, 40):
        assert value(grid, along, -3.0) == OCCUPIED
        assert value(grid, along, 3.0) == OCCUPIED
        assert value(grid, along, -3.0 + 1.5 * STEP) == FREE
        assert value(grid, along, 3.0 + 1.5 * STEP) == UNKNOWN
    for across in np.linspace(-2.9, 2.9, 30):
        assert OCCUPIED in (value(grid, 6.0 - 0.01, across), value(grid, 6.0 + 0.01, across))
        assert OCCUPIED in (value(grid, -2.0 - 0.01, across), value(grid, -2.0 + 0.01, across))
        assert value(grid, 6.0 - 1.6 * STEP, across) == FREE


def test_furniture_and_free_space(grid):
    assert value(grid, 2.5, 1.5) == OCCUPIED  # the table, from above
    assert value(grid, 4.0, -1.75) == OCCUPIED  # the box
    assert value(grid, 0.25, -2.25) == FREE  # below the lamp
    assert all(value(grid, x, 0.0) == FREE for x in np.linspace(-1.0, 5.0, 50))
    free = np.argwhere(grid.cells == FREE)[:, ::-1] * STEP + grid.origin
    assert free.min(axis=0) == pytest.approx([-2.0, -3.0], abs=2 * STEP)
    assert free.max(axis=0) == pytest.approx([6.0, 3.0], abs=2 * STEP)
    assert (grid.cells == FREE).sum() * STEP**2 == pytest.approx(8 * 6 - 1, abs=1.5)


def test_what_the_robot_drove_through_is_free(room):
    """Points of those who walked beside the robot are no obstacle on its own path."""
    points, normals, path = room
    person = patch(at(1.0, -0.1), np.array([0.0, 0.2, 0.0]), np.array([0.0, 0.0, 1.7]))
    more = np.concatenate([points, person]), np.concatenate([normals, np.tile([1.0, 0.0, 0.0], (len(person), 1))])
    for aside_m, expected in ((0.0, FREE), (1.0, OCCUPIED)):
        grid = occupancy_grid(*more, path + np.array([0.0, aside_m, 0.0]), GridOptions(resolution_m=STEP))
        assert value(grid, 1.0, 0.0) == expected


def test_without_ground_there_is_no_grid(room):
    points, normals, path = room
    above = points[:, 2] > SLOPE * points[:, 0]
    assert occupancy_grid(points[above], normals[above], path, GridOptions()) is None


def _read(file: Path) -> tuple[dict[str, object], FloatArray]:
    """As map_server does, by a parser of our own: occupancy of each pixel, the first row at the top."""
    about: dict[str, object] = {}
    for line in file.read_text().splitlines():
        key, _, text = line.partition(":")
        about[key] = text.strip()
    image = (file.parent / str(about["image"])).read_bytes()
    magic, width, height, most = image.split(maxsplit=4)[:4]
    assert (magic, most) == (b"P5", b"255")
    pixels = np.frombuffer(image, np.uint8)[-int(width) * int(height) :]
    return about, (255.0 - pixels.reshape(int(height), int(width))) / 255.0


def test_files_of_grids_mean_the_same_to_the_map_server(room, tmp_path):
    points, normals, path = room
    trajectory = Trajectory(0.1 * np.arange(len(path)), make_transform(np.eye(3), path))
    run, out = write_run(tmp_path / "run", trajectory, PointCloud(points, normals)), tmp_path / "map.yaml"
    command = ["export-grid", str(run), "--out", str(out)]
    succeeds(*command)
    cloud = load_map(run)  # in single precision
    grid = occupancy_grid(cloud.points, cloud.normals, path, GridOptions(resolution_m=STEP))
    about, occupancy = _read(out)
    assert (about["image"], about["mode"], about["negate"]) == ("map.pgm", "trinary", "0")
    assert float(str(about["resolution"])) == STEP
    occupied, free = (float(str(about[f"{name}_thresh"])) for name in ("occupied", "free"))
    meaning = np.select([occupancy > occupied, occupancy < free], [OCCUPIED, FREE], UNKNOWN)[::-1]
    x, y, yaw = (float(word) for word in str(about["origin"]).strip("[]").split(","))
    np.testing.assert_allclose([x, y, yaw], [*grid.origin, 0.0], atol=1e-6)
    np.testing.assert_array_equal(meaning, grid.cells)
    assert lidarslam(*command).exit_code == 1
    succeeds(*command, "--overwrite")
    assert lidarslam("export-grid", run, "--out", tmp_path / "map.png").exit_code == 2


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


def test_the_surface_of_a_mesh_is_the_one_that_was_measured(bowl):
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
def test_files_of_meshes_are_read_by_others(bowl, tmp_path, suffix):
    still = Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))
    run, out = write_run(tmp_path / "run", still, bowl), tmp_path / f"mesh{suffix}"
    command = ["export-mesh", str(run), "--out", str(out), "--cell", "0.3"]
    succeeds(*command)
    mesh = o3d.io.read_triangle_mesh(str(out))
    assert len(mesh.triangles) > 500
    assert distances(np.asarray(mesh.vertices)).max() < 0.3
    colours = np.asarray(mesh.vertex_colors)
    assert suffix in (".obj", ".stl") or (len(colours) and set(np.unique(colours)) == {0.0, 1.0})
    assert lidarslam(*command).exit_code == 1
    assert lidarslam("export-mesh", run, "--out", "mesh.off").exit_code == 2
