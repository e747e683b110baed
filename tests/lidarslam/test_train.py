"""Training from scans to weights: the same seed, the same weights, however often it is interrupted; what teaches."""

import csv
import pickle
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lidarslam.config.settings import load_train_config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import inverse, log, make_transform
from lidarslam.core.scan import Scan
from lidarslam.core.spin_axis import image_axes
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.config import ImageConfig, SimulatedConfig
from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of, read_tensor_file, write_tensor_file
from lidarslam.odometry.network.networks import make_network
from lidarslam.odometry.training.losses import validate
from lidarslam.odometry.training.pairs import AUGMENTATION, Pairs
from lidarslam.odometry.training.preparation import PreparedRecording, prepare
from lidarslam.simulation.mixture import ingredients_of
from lidarslam.simulation.record import RecordRequest, make_simulation
from lidarslam.train import data as training_data
from lidarslam.train.data import MapTeacher, Stretch, draw_weights, hold_out, prepared, recorded, simulated
from lidarslam.train.directory import RESULTS, STATE, earlier_training, remove_results
from lidarslam.train.train import TrainRequest, execute

from ..conftest import lidarslam, succeeds

SIZES = ("images.columns=96", "batch=2", "steps=8", "warmup_steps=2", "hold_out=0.3")
TINY = [f"training.{size}" for size in SIZES]
OPTIONS = [word for setting in TINY for word in ("--set", setting)]


@pytest.fixture(autouse=True, scope="module")
def small_steps() -> Iterator[None]:
    """Frequent reports; and one thread, with which small networks are fastest."""
    earlier = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("lidarslam.train.train.LOG_EVERY", 3)
        patched.setattr("lidarslam.train.train.VALIDATE_EVERY", 4)
        patched.setattr("lidarslam.odometry.training.losses._GEOMETRIC_POINTS", 64)
        yield
    torch.set_num_threads(earlier)


@pytest.fixture(scope="module")
def room_folder(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan]) -> Path:
    """Ten scans without stamps or truth."""
    folder = tmp_path_factory.mktemp("room")
    for index, scan in enumerate(room_scans[:10]):
        np.save(folder / f"{index:06d}.npy", scan.points)
    return folder


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the tests share prepared recordings."""
    return tmp_path_factory.mktemp("ready")


LAST = "weights_last.safetensors"


class Console:
    """Keeps the lines, and presses Ctrl-C after one."""

    def __init__(self, interrupt_at: str | None = None) -> None:
        self.interrupt_at = interrupt_at
        self.lines: list[str] = []

    def __call__(self, line: str) -> None:
        self.lines.append(line)
        if self.interrupt_at is not None and line.startswith(self.interrupt_at):
            signal.raise_signal(signal.SIGINT)

    def validated(self) -> list[int]:
        """Steps after which there was a validation."""
        return [int(line.split()[2]) for line in self.lines if line.startswith("validation")]


def request(source: Path, out: Path, ready: Path, *settings: str, resume: bool = False) -> TrainRequest:
    config = load_train_config(None, [*TINY, *settings])
    return TrainRequest((source,), out, config, device="cpu", prepared=ready, resume=resume)


@pytest.fixture(scope="module")
def whole(room_folder: Path, ready: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Console]:
    """A training from its beginning to its end, and what it said."""
    out, console = tmp_path_factory.mktemp("whole") / "out", Console()
    assert execute(request(room_folder, out, ready), console)
    return out, console


def losses(out: Path) -> list[dict[str, str]]:
    with (out / "train.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "pairs_per_s"} for row in csv.DictReader(file)]


def assert_same(found: Path, expected: Path) -> None:
    assert losses(found) == losses(expected), found.name
    assert (found / "validation.csv").read_bytes() == (expected / "validation.csv").read_bytes(), found.name
    a, b = (load_checkpoint(path / LAST).weights for path in (found, expected))
    assert all(torch.equal(a[name], b[name]) for name in a), found.name


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(("line", "steps", "validated"), [("validation after 4 steps", 4, [0, 4]), ("step 3/", 3, [0])])
def test_an_interrupted_training_goes_on_as_if_it_had_not_been(
    room_folder, tmp_path, ready, whole, line, steps, validated
):
    parts, console = tmp_path / "parts", Console(interrupt_at=line)
    assert not execute(request(room_folder, parts, ready), console)
    assert console.validated() == validated
    assert not any("best so far" in line for line in console.lines if line.startswith("validation after 0 steps"))
    kept = {name: load_checkpoint(parts / name).about["steps"] for name in ("weights.safetensors", LAST)}
    assert kept[LAST] == steps
    of_step = "" if kept["weights.safetensors"] == steps else f" of step {kept['weights.safetensors']}"
    assert console.lines[-1].startswith(f"{steps} steps done; weights{of_step} written to")
    assert "--resume" in console.lines[-1]
    assert execute(request(room_folder, parts, ready, resume=True), print)
    assert [row["step"] for row in losses(parts)] == ["3", "6", "8"]
    assert_same(parts, whole[0])


@contextmanager
def copied_before_each_change(out: Path, copies: Path) -> Iterator[None]:
    """Copies a directory before every file of it that is put in its place or removed: what a kill then leaves."""
    copies.mkdir()

    def copy_first(change: Callable[..., Any]) -> Callable[..., Any]:
        def changed(path: Path, *arguments: Any, **options: Any) -> Any:
            if path.parent == out and path.exists():
                shutil.copytree(out, copies / f"{len(list(copies.iterdir())):02d}")
            return change(path, *arguments, **options)

        return changed

    with pytest.MonkeyPatch.context() as patched:
        for name in ("replace", "unlink"):
            patched.setattr(Path, name, copy_first(getattr(Path, name)))
        yield


@pytest.mark.long
def test_a_killed_training_goes_on_to_the_same_weights(room_folder, tmp_path, ready, whole):
    parts, copies = tmp_path / "parts", tmp_path / "copies"
    with copied_before_each_change(parts, copies):
        assert execute(request(room_folder, parts, ready), print)
        assert execute(request(room_folder, parts, ready, resume=True), print)
    killed = sorted(copies.iterdir())
    assert len(killed) > 9
    for left in [*killed[1:8:4], *killed[-3::2]]:
        assert execute(request(room_folder, left, ready, resume=True), print)
        assert_same(left, whole[0])
        assert not list(left.glob(".partial*"))


def test_a_killed_overwrite_of_a_training_can_be_repeated(tmp_path):
    out, copies = tmp_path / "out", tmp_path / "copies"
    out.mkdir()
    for name in RESULTS:
        (out / name).write_text("trained_on:\n")
    with copied_before_each_change(out, copies):
        remove_results(out, RESULTS)
    killed = sorted(copies.iterdir())
    assert len(killed) == len(RESULTS)
    for left in killed:
        assert earlier_training(left, resume=False, overwrite=True)
    assert not any((left / STATE).exists() for left in killed[1:])


def test_what_a_training_leaves(room_folder, whole):
    out, console = whole
    assert {path.name for path in out.iterdir()} == set(RESULTS)
    assert list((out / "tensorboard").iterdir())
    best = load_checkpoint(out / "weights.safetensors")
    assert f"off by {best.about['validation']['rotation_rms_deg']:.3f} deg" in console.lines[-1]
    assert best.images.columns == 96
    assert best.about["sources"] == [room_folder.name]  # not where it lay


def test_where_no_held_out_pair_can_be_aligned_the_last_weights_are_kept(room_folder, tmp_path, ready, monkeypatch):
    nothing = validate(make_network(load_train_config().training.network), [])
    monkeypatch.setattr("lidarslam.train.train.validate", lambda *_, **__: nothing)
    console = Console()
    execute(request(room_folder, tmp_path / "out", ready), console)
    assert any("nothing to compare with" in line for line in console.lines)
    kept, last = (load_checkpoint(tmp_path / "out" / f"{name}.safetensors") for name in ("weights", "weights_last"))
    assert all(torch.equal(kept.weights[name], last.weights[name]) for name in last.weights)
    assert kept.about["validation"] is None
    assert not any("nan" in line for line in console.lines)


@pytest.fixture(scope="module")
def kept(room_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Stretch, PreparedRecording, Path]:
    """Four scans, prepared, and the folder where they are kept."""
    config, cache = load_train_config(None, TINY), tmp_path_factory.mktemp("kept")
    stretch = replace(recorded(room_folder, config.reader), stop=4)
    (made,) = prepared([stretch], config.training, cache, lambda _: None)
    return stretch, made, cache


def assert_as_kept(kept: tuple[Stretch, PreparedRecording, Path]) -> None:
    stretch, made, cache = kept
    (again,) = prepared([stretch], load_train_config(None, TINY).training, cache, lambda _: None)
    for name, value in vars(made).items():
        assert torch.equal(value, getattr(again, name))
        assert value.dtype == getattr(again, name).dtype


def test_recordings_are_prepared_once(kept, monkeypatch):
    monkeypatch.setattr(training_data, "prepare", lambda *_: pytest.fail("prepared again"))
    assert_as_kept(kept)


def test_nothing_is_prepared_behind_a_link(room_folder, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "prepared").symlink_to(tmp_path / "outside")
    linked = replace(request(room_folder, tmp_path / "out", tmp_path), prepared=None)
    with pytest.raises(OutputError, match="is a link to another place"):
        execute(linked, print)
    assert not any((tmp_path / "outside").iterdir())


@pytest.mark.parametrize(
    "forge",
    [
        lambda tensors: tensors.pop("valid"),
        lambda tensors: tensors.update({n: tensors[n][..., ::2] for n in ("points", "normals", "offsets")}),
        lambda tensors: tensors.update({name: torch.cat([one, one]) for name, one in tensors.items()}),
    ],
    ids=["missing", "other image", "long"],
)
def test_prepared_recordings_that_do_not_fit_are_made_anew(kept, forge):
    (file,) = kept[2].iterdir()
    tensors, content = read_tensor_file(file, training_data._KIND)
    forge(tensors)
    write_tensor_file(file, training_data._KIND, tensors, content)
    assert_as_kept(kept)


def test_whole_recordings_are_held_out_and_the_end_of_a_single_one():
    many = [Stretch(str(number), {}, lambda: pytest.fail("opened"), 0, 50) for number in range(10)]
    learned, held_out = hold_out(many, 0.2, seed=0)
    assert (len(learned), len(held_out), len({*learned, *held_out})) == (8, 2, 10)
    assert hold_out(many, 0.2, seed=0) == (learned, held_out)
    assert any(hold_out(many, 0.2, seed=seed) != (learned, held_out) for seed in range(1, 4))
    assert len(hold_out(many[:2], 0.01, seed=0)[1]) == 1
    (learnt,), (held,) = hold_out(many[:1], 0.1, seed=0)
    assert (learnt.first, learnt.stop, held.first, held.stop) == (0, 45, 45, 50)
    assert hold_out(many, 0.0, seed=0) == (many, [])
    with pytest.raises(InputError, match=r"hold_out=0"):
        hold_out([Stretch("short", {}, lambda: pytest.fail("opened"), 0, 3)], 0.1, seed=0)


def test_of_the_simulated_recordings_some_kinds_can_be_chosen():
    """Those chosen are the same recordings as among all, so that what was prepared serves again."""
    worlds, sensors = ("street", "park"), ("vlp-16", "os1-64")
    everything = simulated(SimulatedConfig(recordings=60))
    chosen = simulated(SimulatedConfig(recordings=60, worlds=worlds, sensors=sensors))
    kinds = [ingredients_of(number, 0) for number in range(60)]
    expected = [n for n, kind in enumerate(kinds) if kind.world in worlds and kind.sensor in sensors]
    assert 0 < len(expected) < 20
    assert [stretch.identity for stretch in chosen] == [everything[number].identity for number in expected]
    with pytest.raises(ConfigError, match=r"simulated\.worlds: there is no 'strete'; choose from street, office"):
        simulated(SimulatedConfig(recordings=1, worlds=("strete",)))
    with pytest.raises(ConfigError, match=r"simulated\.recordings=1: none is of the worlds"):
        simulated(SimulatedConfig(recordings=1, worlds=("park",)))


@pytest.mark.long
def test_the_command_trains_goes_on_and_replaces(room_folder, tmp_path, ready):
    out = tmp_path / "out"
    options = ("train", "--out", out, "--prepared", ready, "--device", "cpu")
    said = succeeds(*options, room_folder, *OPTIONS, "--steps", 3)
    for words in ("training on 1 recording: 7 scans to learn from, 3 more", "step 3/3  loss", "validation after 0"):
        assert words in said
    assert f"lidarslam run SOURCE --weights {out / 'weights.safetensors'}" in said
    refused = lidarslam(*options, room_folder, *OPTIONS)
    assert refused.exit_code == 1
    assert "holds a training already" in refused.output
    # On what it was begun, and how, is remembered.
    assert "going on after step 3" in succeeds(*options, "--resume", "--steps", 5)
    assert [row["step"] for row in losses(out)] == ["3", "5"]
    shutil.copy(out / "weights.safetensors", begun := tmp_path / "begun.safetensors")
    succeeds(*options, room_folder, "--overwrite", "--steps", 2, "--from", begun)
    assert [row["step"] for row in losses(out)] == ["2"]
    kept = load_checkpoint(out / LAST)
    assert kept.images.columns == 96
    # Killed before its first state, it begins with the same weights again.
    (out / "state.safetensors").unlink()
    succeeds(*options, "--resume")
    resumed = load_checkpoint(out / LAST)
    assert all(torch.equal(kept.weights[name], resumed.weights[name]) for name in kept.weights)
    assert resumed.about["from"] == "begun.safetensors"


def test_other_recordings_or_files_are_not_gone_on_with(room_folder, tmp_path, ready):
    out = tmp_path / "out"
    execute(request(room_folder, out, ready, "training.steps=1"), print)
    with pytest.raises(ConfigError, match="not those that this training was begun with"):
        execute(request(room_folder, out, ready, "reader.rate_hz=5", resume=True), print)
    (out / "state.safetensors").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(InputError, match="is no safetensors file"):
        execute(request(room_folder, out, ready, resume=True), print)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "weights.safetensors").write_text("mine")
    with pytest.raises(OutputError, match="not those of a training"):
        execute(request(room_folder, tmp_path / "foreign", ready), print)


@pytest.mark.slow
def test_a_short_recording_is_learnt_by_heart(room_folder, tmp_path, ready, monkeypatch):
    """Labels play no part: alignment found the motions that the error is measured against."""
    unchanged = AUGMENTATION._replace(roll=0.0, any_roll=0.0, mirror=0.0, scale=0.0, drop_beams=0.0, hide_sector=0.0)
    monkeypatch.setattr("lidarslam.train.train.Pairs", partial(Pairs, augmentation=unchanged))
    monkeypatch.setattr("lidarslam.train.train.VALIDATE_EVERY", 100)
    settings = ("training.steps=300", "training.batch=8", "training.hold_out=0.0")
    execute(request(room_folder, tmp_path / "out", ready, *settings), print)
    trained = load_checkpoint(tmp_path / "out" / "weights.safetensors")
    config = load_train_config(None, TINY)
    recording = prepared([recorded(room_folder, config.reader)], config.training, ready, lambda _: None)
    before = validate(make_network(trained.network).eval(), recording)
    after = validate(network_of(trained), recording)
    assert after.rotation_rms_deg < 0.5 * before.rotation_rms_deg
    assert after.translation_rms_m < 0.8 * before.translation_rms_m  # 7 cm before, of cells of 50 cm


SCANS = 14


@pytest.fixture(scope="module")
def at_speed() -> tuple[list[Scan], Trajectory]:
    """A car that is at speed from the first scan on, half a metre from scan to scan."""
    request = RecordRequest(Path(), "street", "vlp-16", "car-fast", "upright", SCANS, 5, "", speed_mps=6.0)
    simulation = make_simulation(request)
    return list(simulation.scans()), simulation.ground_truth


# Axes of a camera: x to the right, y down, z forward.
R_CAMERA_LIDAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@pytest.mark.long
@pytest.mark.parametrize("R_recorded_lidar", [np.eye(3), R_CAMERA_LIDAR], ids=["upright", "camera"])
def test_the_map_teaches_the_true_motions_between_the_middles_of_sweeps(at_speed, R_recorded_lidar):
    scans, truth = at_speed
    scans = [replace(scan, points=scan.points @ R_recorded_lidar.T) for scan in scans]
    teacher = MapTeacher()
    for scan in scans:
        teacher.follow(scan)
    taught = teacher.relabelled(prepare(iter(scans), ImageConfig()))
    middles = np.array([scan.stamp + scan.middle_offset_s for scan in scans[:-1]])
    poses = truth.at(middles, 0.1)
    T_image_lidar = make_transform(image_axes(scans[0].points) @ R_recorded_lidar, np.zeros(3))
    expected = T_image_lidar @ inverse(poses[:-1]) @ poses[1:] @ inverse(T_image_lidar)
    sure = taught.valid.numpy()[: SCANS - 2]
    assert sure.mean() > 0.7
    errors = log(inverse(taught.T_prev_curr.double().numpy()[: SCANS - 2]) @ expected)[sure]
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.05
    assert np.rad2deg(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.3
    assert np.linalg.norm(expected[:, :3, 3], axis=1).min() > 0.4


def test_what_is_not_sure_is_not_taught(at_speed):
    scans, _ = at_speed
    teacher = MapTeacher()
    strange = [*scans[:5], Scan(scans[5].points[:40], scans[5].stamp), *scans[6:9]]
    for scan in strange:
        teacher.follow(scan)
    taught = teacher.relabelled(prepare(iter(strange), ImageConfig()))
    assert taught.valid.dtype == torch.bool
    assert not taught.valid[4]
    assert not taught.valid[5]


def stretch(scans: int, simulated: bool) -> Stretch:
    identity = {"simulated": 1} if simulated else {"source": "somewhere"}
    return Stretch("some", identity, lambda: pytest.fail("opened"), 0, scans)


@pytest.mark.parametrize(("recorded", "simulated", "weights"), [
    ([100, 300], [40, 40, 40], [0.075, 0.225, 0.7 / 3, 0.7 / 3, 0.7 / 3]), ([1200], [40], [0.1, 0.1, 0.1, 0.7]),
    ([10, 400], [], [1.0, 1.0]), ([], [10, 400], [1.0, 1.0]),
])  # fmt: skip
def test_recordings_have_pairs_by_their_lengths_and_long_ones_are_drawn_in_pieces(recorded, simulated, weights):
    given = [*(stretch(scans, False) for scans in recorded), *(stretch(scans, True) for scans in simulated)]
    assert draw_weights(given) == pytest.approx(weights)
