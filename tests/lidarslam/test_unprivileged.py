"""A user who can write neither the installation nor a home folder, as the kernel refuses it."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("lidarslam", "mapping", "odometry", "evaluation")
WARNING = "set NUMBA_CACHE_DIR to a folder that can be written"
# Root may write anywhere, unless it gives its capabilities up.
WITHOUT_PRIVILEGES = ("setpriv", "--bounding-set=-all", "--inh-caps=-all") if os.geteuid() == 0 else ()

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(WITHOUT_PRIVILEGES) and not shutil.which("setpriv"), reason="root needs setpriv"),
]


def set_writable(folder: Path, writable: bool) -> None:
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            path.chmod(path.stat().st_mode | 0o200 if writable else path.stat().st_mode & ~0o222)


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The program with its compiled loops, read-only; the folder that holds its packages."""
    folder = tmp_path_factory.mktemp("installation")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, symlinks=True)
    command = [sys.executable, "-m", "lidarslam.pipeline.compile_ahead"]
    subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(folder)}, check=True, timeout=600)
    set_writable(folder, False)
    yield folder
    set_writable(folder, True)


Command = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def lidarslam(installation: Path, tmp_path: Path) -> Iterator[Command]:
    """Runs the program in the folder `work`, the only one that can be written besides `temporary`."""
    for name in ("work", "temporary", "home"):
        (tmp_path / name).mkdir()
    set_writable(tmp_path / "home", False)
    kept = ("PATH", "LANG", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    environment |= {"PYTHONPATH": str(installation), "NUMBA_DEBUG_CACHE": "1"}
    environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "temporary")}

    def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
        command = [*WITHOUT_PRIVILEGES, sys.executable, "-m", "lidarslam", *map(str, arguments)]
        return subprocess.run(
            command, cwd=tmp_path / "work", env=environment, capture_output=True, text=True, check=False, timeout=300
        )

    yield run
    set_writable(tmp_path / "home", True)


@pytest.mark.parametrize("keeps", [True, False], ids=["a temporary folder", "no folder for compiled code"])
def test_what_was_compiled_at_installation_is_used(
    lidarslam: Command, installation: Path, small_recording: Path, tmp_path: Path, keeps: bool
) -> None:
    if not keeps:  # another user may have taken the name
        (tmp_path / "temporary" / f"lidarslam-{os.getuid()}").write_text("")
    for words, exit_status in (
        (("info", small_recording), 0),
        (("run", small_recording, "--out", "run"), 0),
        (("compare", small_recording, "--out", "both", "--methods", "learned+map,kiss-icp"), 0),
    ):
        result = lidarslam(*words)
        assert result.returncode == exit_status, result.stderr
        assert WARNING not in result.stderr
    assert f"data loaded from '{installation}" in lidarslam("run", small_recording, "--out", "again").stdout
    assert not list(tmp_path.rglob("*.nbc"))
    assert not list((tmp_path / "home").iterdir())


def test_what_cannot_be_written_is_named(
    lidarslam: Command, installation: Path, small_recording: Path, tmp_path: Path
) -> None:
    for out in (installation / "run", tmp_path / "home" / "run"):
        result = lidarslam("run", small_recording, "--out", out)
        assert result.returncode == 1
        assert result.stderr.splitlines() == [f"lidarslam: {out}: cannot be written (Permission denied)"]
