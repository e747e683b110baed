"""TUM and KITTI files: round trips, hand-written lines, and what is wrong with a file in which line."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import exp, inverse, is_rigid
from lidarslam.core.trajectory import (
    Trajectory,
    format_kitti,
    format_tum,
    parse_numbers,
    read_kitti_poses,
    read_tum,
    write_tum,
)

# A quarter turn to the left about z; x looks along y.
QUARTER_TURN = np.array([[0.0, -1.0, 0.0, 1.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
QUARTER_TURN_TUM = "12.5 1.5 -2 0.25 0 0 0.70710678118654757 0.70710678118654757"


@pytest.fixture
def written(tmp_path):
    """Write text to a file and return its path."""

    def write(text: str | bytes, name: str = "poses.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_tum_round_trip_keeps_nine_decimals(random_trajectory, tmp_path):
    trajectory = random_trajectory(50)
    write_tum(tmp_path / "t.tum", trajectory)
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(back.stamps, trajectory.stamps, atol=3e-7, rtol=0)  # a double has no more digits here
    np.testing.assert_allclose(back.positions, trajectory.positions, atol=6e-10, rtol=0)
    np.testing.assert_allclose(back.T_world_lidar, trajectory.T_world_lidar, atol=5e-9, rtol=0)


def test_tum_keeps_every_rotation_and_writes_qw_not_negative(rng, written):
    axes = rng.normal(size=(100, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.repeat([0.0, 1e-6, 1.0, 3.0, np.pi], 20)
    T = exp(np.column_stack([axes * angles[:, None], np.zeros((100, 3))]))
    text = format_tum(Trajectory(np.arange(100.0), T))
    assert all(float(line.split()[7]) >= 0.0 for line in text.splitlines())
    np.testing.assert_allclose(read_tum(written(text)).T_world_lidar, T, atol=5e-9)


def test_quaternion_order_is_x_y_z_w(written):
    trajectory = read_tum(written(QUARTER_TURN_TUM))
    assert trajectory.stamps.tolist() == [12.5]
    np.testing.assert_allclose(trajectory.T_world_lidar[0], QUARTER_TURN, atol=1e-15)
    numbers = [float(word) for word in format_tum(trajectory).split()]
    np.testing.assert_allclose(numbers, [float(word) for word in QUARTER_TURN_TUM.split()], atol=5e-10)


@pytest.mark.parametrize(
    "text",
    [
        "# stamp tx ty tz qx qy qz qw\n\n1 0 0 0 0 0 0 1\n   \n2 1 0 0 0 0 0 1 # a remark\n",
        "\ufeff1 0 0 0 0 0 0 1\r\n2 1 0 0 0 0 0 1\r\n",
        "\ufeff#timestamp, p_x, p_y, p_z, q_x, q_y, q_z, q_w\n1, 0, 0, 0, 0, 0, 0, 1\n2,1,0,0,0,0,0,1",
        "1\t0 0 0   0 0 0 1\n2e0 1.0 -0 0 0 0 0 1",
        "2 1 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n",
        "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n2 7 7 7 0 0 0 1\n1 7 7 7 0 0 0 1\n",
        "1 0 0 0 0 0 0 1.01\n2 1 0 0 0 0 0 -0.99\n",
    ],
    ids=["comments", "BOM and CRLF", "commas and header", "tabs", "unordered", "duplicate", "not quite unit"],
)
def test_tum_dialects(text, written):
    trajectory = read_tum(written(text))
    assert trajectory.stamps.tolist() == [1.0, 2.0]
    np.testing.assert_array_equal(trajectory.positions, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(trajectory.T_world_lidar[:, :3, :3], [np.eye(3)] * 2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", r"poses\.txt:2: expected 8 numbers, got 7"),
        ("# header\n1 0 0 0 zero 0 0 1\n", r"poses\.txt:2: expected 8 numbers, got '1 0 0 0 zero 0 0 1'"),
        ("1 0 0 0 0 0 0 nan\n", r"poses\.txt.*no poses"),
        ("1 0 0 0 0 0 0 0\n", r"poses\.txt.*no poses"),
        ("1 0 0 0 90 0 45 1\n", r"poses\.txt.*no poses"),
        ("# only a header\n", r"poses\.txt: holds no pose; expected"),
        (b"\xff\xfe\x00\x01", r"poses\.txt: cannot be read as text"),
    ],
)
def test_what_is_wrong_with_a_tum_file(text, words, written):
    with pytest.raises(InputError, match=words):
        read_tum(written(text))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"absent\.tum: cannot be read"):
        read_tum(tmp_path / "absent.tum")
    with pytest.raises(InputError, match=r"absent\.txt: cannot be read"):
        read_kitti_poses(tmp_path / "absent.txt")


def test_kitti_round_trip(random_trajectory, written):
    poses = random_trajectory(30).T_world_lidar
    back = read_kitti_poses(written(format_kitti(poses)))
    np.testing.assert_allclose(back, poses, rtol=1e-8, atol=1e-8)
    assert is_rigid(back, 1e-12)


def test_kitti_rows_are_read_row_by_row(written):
    row = " ".join(f"{x:g}" for x in QUARTER_TURN[:3].ravel())
    np.testing.assert_allclose(read_kitti_poses(written(row)), QUARTER_TURN[None], atol=1e-15)
    assert len(format_kitti(QUARTER_TURN[None]).split()) == 12


def test_rounded_kitti_rotations_are_mended(written, random_trajectory):
    poses = random_trajectory(20).T_world_lidar
    text = "\n".join(" ".join(f"{x:.3f}" for x in T[:3].ravel()) for T in poses)
    back = read_kitti_poses(written(text))
    assert is_rigid(back, 1e-12)
    np.testing.assert_allclose(back, poses, atol=3e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1\n", r"poses\.txt:1: expected 12 numbers, got 11"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", r"poses\.txt.*no poses"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", r"poses\.txt.*no poses"),
        ("", r"poses\.txt: holds no pose; expected twelve"),
    ],
)
def test_what_is_wrong_with_a_kitti_file(text, words, written):
    with pytest.raises(InputError, match=words):
        read_kitti_poses(written(text))


def test_trajectories_are_saved_and_loaded_as_both_texts(random_trajectory, tmp_path):
    trajectory = random_trajectory(20)
    trajectory.save(tmp_path / "t.tum")
    assert (tmp_path / "t.tum").read_text() == format_tum(trajectory)
    loaded = Trajectory.load(str(tmp_path / "t.tum"))
    np.testing.assert_allclose(loaded.T_world_lidar, trajectory.T_world_lidar, atol=5e-9)
    for name, format in (("t.kitti", None), ("t.txt", "kitti")):
        trajectory.save(tmp_path / name, format)
        assert (tmp_path / name).read_text() == format_kitti(trajectory.T_world_lidar)
        loaded = Trajectory.load(tmp_path / name, format)
        np.testing.assert_allclose(loaded.stamps, 0.1 * np.arange(20))
        np.testing.assert_allclose(loaded.T_world_lidar, trajectory.T_world_lidar, rtol=1e-8, atol=1e-8)
    with pytest.raises(InputError, match="which has no stamps"):
        Trajectory.load(tmp_path / "t.txt")
    with pytest.raises(OutputError, match=r"absent/t\.tum: cannot be written"):
        trajectory.save(tmp_path / "absent" / "t.tum")


def test_poses_of_kitti_s_camera_become_those_of_the_lidar(random_trajectory, tmp_path):
    of_lidar, T_cam_lidar = random_trajectory(10), exp(np.array([1.2, -1.2, 1.2, 0.1, -0.2, 0.3]))
    of_camera = T_cam_lidar @ of_lidar.T_world_lidar @ inverse(T_cam_lidar)
    (tmp_path / "04.txt").write_text(format_kitti(of_camera))
    loaded = Trajectory.from_kitti(tmp_path / "04.txt", of_lidar.stamps.tolist(), T_cam_lidar)
    np.testing.assert_array_equal(loaded.stamps, of_lidar.stamps)
    np.testing.assert_allclose(loaded.T_world_lidar, of_lidar.T_world_lidar, atol=1e-6)
    with pytest.raises(InputError, match=r"holds 10 poses, and the stamps have the shape \(7,\)"):
        Trajectory.from_kitti(tmp_path / "04.txt", of_lidar.stamps[:7])


def test_numbers_of_an_empty_file_have_their_columns(written):
    assert parse_numbers(written("# nothing\n"), columns=5).shape == (0, 5)
