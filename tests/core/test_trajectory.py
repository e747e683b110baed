"""Trajectories: what they are made of, what is measured along them, interpolation; TUM and KITTI files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import exp, inverse, is_rigid
from lidarslam.core.trajectory import Trajectory, chain, format_kitti, format_tum, read_kitti_poses, read_tum

TWIST = np.array([0.1, -0.2, 0.3, 2.0, 0.5, -0.1])


@pytest.fixture
def random_trajectory(rng: np.random.Generator) -> Callable[..., Trajectory]:
    """Unrelated poses up to a kilometre away, with stamps as of a clock since 1970."""

    def make(poses: int = 20) -> Trajectory:
        stamps = 1.6e9 + np.cumsum(rng.uniform(0.05, 0.15, poses))
        return Trajectory(stamps, exp(rng.normal(0.0, [1.0, 1.0, 1.0, 300.0, 300.0, 30.0], (poses, 6))))

    return make


def moving(stamps) -> Trajectory:
    """Constant body velocity, for which interpolation is exact."""
    stamps = np.asarray(stamps, dtype=np.float64)
    return Trajectory(stamps, exp(stamps[:, None] * TWIST))


@pytest.mark.parametrize(
    ("stamps", "poses", "words"),
    [
        ([[0.0], [1.0]], np.stack([np.eye(4)] * 2), r"\(N,\), got \(2, 1\)"),
        ([0.0, 1.0], np.eye(4)[None], r"\(2, 4, 4\), got \(1, 4, 4\)"),
        ([0.0, np.nan], np.stack([np.eye(4)] * 2), "finite"),
        ([0.0, 2.0, 1.0], np.stack([np.eye(4)] * 3), r"2\.0+ then 1\.0+ at rows 1 and 2"),
        ([0.0, 0.0], np.stack([np.eye(4)] * 2), "must increase.*rows 0 and 1"),
        ([0.0, 1.0], np.stack([np.eye(4), 2 * np.eye(4)]), "rigid"),
        ([0.0, 1.0], np.stack([np.eye(4), np.nan * np.eye(4)]), "rigid"),
    ],
)
def test_construction_is_checked(stamps, poses, words):
    with pytest.raises(ValueError, match=words):
        Trajectory(np.array(stamps), poses)


def test_lengths_of_a_known_path():
    positions = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12], [3, 4, 12]])
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, 3] = positions
    trajectory = Trajectory(np.array([10.0, 11.0, 12.0, 15.5]), T)
    np.testing.assert_array_equal(trajectory.positions, positions)
    np.testing.assert_array_equal(trajectory.distances, [0, 5, 17, 17])
    assert (trajectory.length_m, trajectory.duration_s, len(trajectory)) == (17.0, 5.5, 4)


@pytest.mark.parametrize("poses", [0, 1])
def test_a_trajectory_may_be_empty_or_a_single_pose(poses):
    trajectory = moving(np.arange(poses))
    assert (trajectory.length_m, trajectory.duration_s) == (0.0, 0.0)
    assert trajectory.distances.shape == (poses,)
    assert trajectory.relative_motions().shape == (0, 4, 4)
    with pytest.raises(ValueError, match=f"two poses or more, the trajectory has {poses}"):
        trajectory.at(np.array([0.0]))


def test_chain_inverts_relative_motions(random_trajectory):
    trajectory = random_trajectory()
    motions = trajectory.relative_motions()
    T_prev_curr = inverse(trajectory.T_world_lidar[4]) @ trajectory.T_world_lidar[5]
    np.testing.assert_allclose(motions[4], T_prev_curr, atol=1e-9)
    np.testing.assert_allclose(chain(trajectory.T_world_lidar[0], motions), trajectory.T_world_lidar, atol=1e-9)
    np.testing.assert_array_equal(chain(np.eye(4), np.zeros((0, 4, 4))), [np.eye(4)])


def test_interpolation_is_exact_for_constant_body_velocity():
    trajectory = moving([0.0, 0.1, 0.35, 0.4, 1.0])
    stamps = np.array([0.72, 0.0, 0.05, 1.0, 0.1, 0.39])
    expected = moving(np.sort(stamps)).T_world_lidar[[4, 0, 1, 5, 2, 3]]
    np.testing.assert_allclose(trajectory.at(stamps), expected, atol=1e-12)
    assert trajectory.at(np.zeros(0)).shape == (0, 4, 4)


def test_extrapolation_goes_on_with_the_first_or_last_motion_as_far_as_allowed():
    trajectory = moving([0.0, 0.5, 1.0])
    stamps = np.array([-0.2, 1.2])
    found = trajectory.at(stamps, extrapolation_s=0.2)
    np.testing.assert_allclose(found, moving(stamps).T_world_lidar, atol=1e-12)
    for outside in (-0.21, 1.21):
        with pytest.raises(ValueError, match=r"outside the trajectory \(0\.0+ to 1\.0+\)"):
            trajectory.at(np.array([0.5, outside]), extrapolation_s=0.2)


# A quarter turn to the left about z; x looks along y.
QUARTER_TURN = np.array([[0.0, -1.0, 0.0, 1.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
QUARTER_TURN_TUM = "12.5 1.5 -2 0.25 0 0 0.70710678118654757 0.70710678118654757"


@pytest.fixture
def written(tmp_path):
    def write(text: str | bytes, name: str = "poses.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_tum_round_trip_keeps_nine_decimals(random_trajectory, tmp_path):
    trajectory = random_trajectory(50)
    trajectory.save(tmp_path / "t.tum")
    assert (tmp_path / "t.tum").read_text() == format_tum(trajectory)
    back = Trajectory.load(str(tmp_path / "t.tum"))
    np.testing.assert_allclose(back.stamps, trajectory.stamps, atol=3e-7, rtol=0)  # a double has no more digits here
    np.testing.assert_allclose(back.positions, trajectory.positions, atol=6e-10, rtol=0)
    np.testing.assert_allclose(back.T_world_lidar, trajectory.T_world_lidar, atol=5e-9, rtol=0)


def test_tum_keeps_every_rotation_as_x_y_z_w_and_writes_w_not_negative(rng, written):
    axes = rng.normal(size=(100, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.repeat([0.0, 1e-6, 1.0, 3.0, np.pi], 20)
    T = exp(np.column_stack([axes * angles[:, None], np.zeros((100, 3))]))
    text = format_tum(Trajectory(np.arange(100.0), T))
    assert all(float(line.split()[7]) >= 0.0 for line in text.splitlines())
    np.testing.assert_allclose(read_tum(written(text)).T_world_lidar, T, atol=5e-9)
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
    ("read", "text", "words"),
    [
        (read_tum, "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", r"poses\.txt:2: expected 8 numbers, got 7 words"),
        (read_tum, "# header\n1 0 0 0 zero 0 0 1\n", r"txt:2: expected 8 numbers, got 8 words, .1 0 0 0 zero"),
        (read_tum, "1 0 0 0 0 0 0 nan\n", r"poses\.txt.*no poses"),
        (read_tum, "1 0 0 0 0 0 0 0\n", r"poses\.txt.*no poses"),
        (read_tum, "1 0 0 0 90 0 45 1\n", r"poses\.txt.*no poses"),
        (read_tum, "# only a header\n", r"poses\.txt: holds no pose; expected"),
        (read_tum, b"\xff\xfe\x00\x01", r"poses\.txt: cannot be read as text"),
        (read_kitti_poses, "1 0 0 0 0 1 0 0 0 0 1\n", r"poses\.txt:1: expected 12 numbers, got 11 words"),
        (read_kitti_poses, "2 0 0 0 0 2 0 0 0 0 2 0\n", r"poses\.txt.*no poses"),
        (read_kitti_poses, "1 0 0 0 0 1 0 0 0 0 -1 0\n", r"poses\.txt.*no poses"),
        (read_kitti_poses, "", r"poses\.txt: holds no pose; expected twelve"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(read, text, words, written):
    with pytest.raises(InputError, match=words):
        read(written(text))


def test_kitti_poses_are_saved_and_loaded_and_rounded_rotations_mended(written, random_trajectory, tmp_path):
    trajectory = random_trajectory(20)
    poses = trajectory.T_world_lidar
    text = "\n".join(" ".join(f"{x:.3f}" for x in T[:3].ravel()) for T in poses)
    back = read_kitti_poses(written(text))
    assert is_rigid(back, 1e-12)
    np.testing.assert_allclose(back, poses, atol=3e-3)
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
