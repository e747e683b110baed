"""The commands without the extras `train` and `live`: their libraries are hidden behind modules that are not found."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidarslam.odometry.registry import default_weights

HIDDEN = ("torch", "tensorboard", "safetensors", "onnx", "onnxscript", "cyclonedds")


@pytest.fixture(scope="module")
def base_install(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment, for processes and their children, in which the libraries cannot be imported."""
    hidden = tmp_path_factory.mktemp("hidden")
    for name in HIDDEN:
        (hidden / f"{name}.py").write_text(f"raise ModuleNotFoundError('hidden', name={name!r})\n")
    path = os.pathsep.join([str(hidden), *sys.path])
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


def run(arguments: list[str], environment: dict[str, str], folder: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.long
def test_every_command_but_training_and_export_does_without(base_install, tmp_path):
    commands = [
        "simulate --out office --world office --scans 6 --format ply",
        "info office",
        "config",
        "run office --out run",
        "run office --out loam --mapping loam --odometry kiss-icp",
        "evaluate run",
        "view run --save run.rrd",
        "view run --picture map.png",
        "compare office --out compared --methods learned+map+graph,kiss-icp",
    ]
    code = (
        "from lidarslam.cli import main\n"
        f"for command in {commands}:\n"
        "    print(command)\n"
        "    main(command.split(), standalone_mode=False)\n"
        "import sys\n"
        f"print('imported:', sorted(set({HIDDEN}) & set(sys.modules)))\n"
    )
    done = run(["-c", code], base_install, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "imported: []"
    assert all((tmp_path / name).exists() for name in ("run/map.ply", "run.rrd", "map.png", "compared/report.html"))


@pytest.mark.parametrize(
    ("arguments", "purpose"),
    [
        (["train", "--out", "trained"], "training"),
        (["export", "--out", "exported"], "an export"),
        (["run", "scans", "--out", "run", "--weights", str(default_weights())], "a file of weights"),
        (["run", "scans", "--out", "run", "--set", "odometry.learned.device=cuda"], "odometry.learned.device=cuda"),
        (["live", "--out", "run"], "live"),
    ],
    ids=["train", "export", "weights", "accelerator", "live"],
)
def test_what_needs_the_extra_says_so_in_one_line(arguments, purpose, base_install, tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    for number in range(2):
        (scans / f"{number}.bin").write_bytes(b"\x00\x00\x80\x3f" * 4 * 500)
    done = run(["-m", "lidarslam", *arguments], base_install, tmp_path)
    (line,) = done.stderr.splitlines()
    library, extra = ("cyclonedds", "live") if purpose == "live" else ("torch", "train")
    assert f"{library} is not installed, which {purpose} needs; pip install 'lidarslam[{extra}]'" in line
    assert ("CPU build" in line) == (extra == "train")
    assert done.returncode == 1
    assert not (tmp_path / "trained").exists()
    assert not (tmp_path / "exported").exists()
