"""Maps, occupancy grids and meshes of known surfaces, and their files as other programs read them."""

from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.scan import PointAttributes
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map import point_cloud
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
from lidarslam.mapping.global_map.point_cloud import PointCloud, require_format, write_cloud
from lidarslam.storage.finished_run import load_map

from ..conftest import lidarslam, succeeds, write_run
from .shapes import attributes

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


FORMATS = ["map.ply", "map.pcd", "map.laz", "map.e57"]


@pytest.fixture
def cloud(rng: np.random.Generator) -> PointCloud:
    """Points with all attributes; one has no intensity, one no ring."""
    normals, known = rng.normal(size=(500, 3)), attributes(rng, 500)
    known.intensity[3], known.ring[4] = np.nan, -1
    points = rng.normal(0.0, 30.0, (500, 3)).astype(np.float32).astype(np.float64)
    return PointCloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), known)


@pytest.mark.parametrize("name", ["map.ply", "map.pcd"])
def test_open3d_and_this_program_read_every_attribute(tmp_path, cloud, name, monkeypatch):
    monkeypatch.setattr("lidarslam.core.point_files.POINTS_AT_A_TIME", 200)
    write_cloud(tmp_path / name, cloud)
    read = o3d.t.io.read_point_cloud(str(tmp_path / name)).point
    np.testing.assert_array_equal(read.positions.numpy(), cloud.points)
    np.testing.assert_array_equal(read.normals.numpy(), cloud.normals.astype(np.float32))
    np.testing.assert_array_equal(read.colors.numpy(), cloud.attributes.rgb)
    for attribute in ("intensity", "ring", "time"):
        np.testing.assert_array_equal(read[attribute].numpy()[:, 0], getattr(cloud.attributes, attribute))
    back = load_map(tmp_path / name)
    np.testing.assert_array_equal(back.points, cloud.points)
    expected = dict(cloud.attributes.present())
    for attribute, values in back.attributes.present():
        np.testing.assert_array_equal(values, expected.pop(attribute))
    assert not expected


def test_laspy_reads_laz(tmp_path, cloud):
    write_cloud(tmp_path / "map.laz", cloud)
    read, known = laspy.read(tmp_path / "map.laz"), cloud.attributes
    assert read.header.are_points_compressed
    np.testing.assert_allclose(read.xyz, cloud.points, atol=0.51e-4)
    np.testing.assert_array_equal(read.NormalZ, cloud.normals[:, 2].astype(np.float32))
    np.testing.assert_allclose(read.intensity, np.nan_to_num(known.intensity), atol=0.5)
    np.testing.assert_array_equal(read.ring, known.ring)
    np.testing.assert_array_equal(read.gps_time, known.time)
    np.testing.assert_array_equal(np.column_stack([read.red, read.green, read.blue]) // 257, known.rgb)
    assert set(read.return_number) == set(read.number_of_returns) == {1}


@pytest.mark.parametrize(
    ("brightest", "expected"), [(None, [0, 39321, 65535]), (1.0, [0, 39321, 65535]), (255.0, [0, 1, 1])]
)
def test_intensities_up_to_one_fill_the_bits_of_laz(tmp_path, brightest, expected):
    """A tile's are on the scale of its map."""
    dark = PointCloud(np.eye(3), np.eye(3), PointAttributes(intensity=np.array([0.0, 0.6, 1.0], dtype=np.float32)))
    write_cloud(tmp_path / "0_0.laz", dark, brightest)
    assert laspy.read(tmp_path / "0_0.laz").intensity.tolist() == expected


def test_pye57_reads_e57(tmp_path, cloud):
    pye57 = pytest.importorskip("pye57")
    write_cloud(tmp_path / "map.e57", cloud)
    file = pye57.E57(str(tmp_path / "map.e57"))
    read, known = file.read_scan(0, intensity=True, colors=True), cloud.attributes
    file.close()
    for column, axis in enumerate("XYZ"):
        np.testing.assert_allclose(read[f"cartesian{axis}"], cloud.points[:, column], atol=1e-5)
    np.testing.assert_array_equal(read["intensity"], np.nan_to_num(known.intensity))
    for column, colour in enumerate(("Red", "Green", "Blue")):
        np.testing.assert_array_equal(read[f"color{colour}"], known.rgb[:, column])


@pytest.mark.parametrize("name", FORMATS)
def test_a_map_is_written_in_every_format_or_the_folder_is_named(tmp_path, name):
    if name.endswith("e57"):
        pytest.importorskip("pye57")
    write_cloud(tmp_path / name, PointCloud(np.eye(3), np.eye(3)))
    assert (tmp_path / name).stat().st_size > 100
    suffix = name.removeprefix("map")
    with pytest.raises(OutputError, match=rf"none: the \{suffix} map cannot be written there \(.+\)$") as caught:
        write_cloud(tmp_path / "none" / f".partial-1-{name}", PointCloud(np.eye(3), np.eye(3)))
    assert ".partial" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with pytest.raises(OutputError, match="a map without points"):
        write_cloud(tmp_path / "map.ply", PointCloud(np.empty((0, 3)), np.empty((0, 3))))
    with pytest.raises(OutputError, match=r"map\.xyz: expected a name that ends in \.ply, \.pcd, \.laz, \.e57"):
        PointCloud(np.eye(3), np.eye(3)).save(str(tmp_path / "map.xyz"))
    monkeypatch.setattr(point_cloud, "find_spec", lambda _name: None)
    with pytest.raises(OutputError, match="E57 maps need pye57"):
        require_format("e57")
