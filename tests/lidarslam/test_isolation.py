"""A run touches its directory and nothing else: no other file, no network, no code out of a file."""

import ast
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ..conftest import lidarslam

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("lidarslam", "odometry", "mapping", "evaluation")
# What runs, or may run, code in a file or text; `yaml.load` only with the loader of lidarslam.config.yaml_text.
NEVER = {
    "eval", "exec", "compile", "os.system", "os.popen", "os.execv", "os.execvp",
    "pickle.load", "pickle.loads", "torch.load", "joblib.load", "shelve.open", "marshal.loads",
    "yaml.load", "yaml.unsafe_load", "yaml.full_load", "yaml.load_all",
    "tarfile.open", "zipfile.ZipFile", "shutil.unpack_archive", "urllib.request.urlopen",
}  # fmt: skip
NEVER_IMPORTED = {"pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "requests", "urllib.request", "httpx"}
ALLOWED = {
    ("lidarslam/config/yaml_text.py", "yaml.load"),
    ("lidarslam/assessment/evaluate.py", "zipfile.ZipFile"),  # writes alone
    ("lidarslam/compare/comparison.py", "tarfile.open"),  # of our own tasks, and extracted with the filter of data
}


def _name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f"{_name(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def breaches(tree: ast.AST) -> Iterator[str]:
    """What in a module could run what a file says, or fetch something."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (name for name in names if name in NEVER_IMPORTED)
        if isinstance(node, ast.Call):
            if _name(node.func) in NEVER:
                yield _name(node.func)
            for keyword in node.keywords:
                is_true = isinstance(keyword.value, ast.Constant) and keyword.value.value is True
                if keyword.arg in ("shell", "allow_pickle") and is_true:
                    yield f"{keyword.arg}=True"
            if _name(node.func) in ("np.load", "numpy.load") and "allow_pickle" not in {k.arg for k in node.keywords}:
                yield "np.load"


def test_nothing_in_the_sources_runs_what_a_file_says() -> None:
    found = []
    for path in (path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")):
        name = str(path.relative_to(REPOSITORY))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [(name, breach) for breach in breaches(tree) if (name, breach) not in ALLOWED]
    assert found == []


@pytest.mark.parametrize(
    ("planted", "breach"),
    [
        ("import pickle", "pickle"),
        ("def f(x):\n  return torch.load(x)", "torch.load"),
        ("yaml.load(text, Loader=yaml.Loader)", "yaml.load"),
        ("subprocess.run(x, shell=True)", "shell=True"),
        ("np.load(path, allow_pickle=True)", "allow_pickle=True"),
        ("np.load(path)", "np.load"),
        ("eval(text)", "eval"),
    ],
)
def test_a_planted_breach_is_found(planted: str, breach: str) -> None:
    assert breach in list(breaches(ast.parse(planted)))


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("somebody asked the network")

    for name in ("connect", "connect_ex", "sendto", "bind"):
        monkeypatch.setattr(socket.socket, name, refuse)
    for name in ("getaddrinfo", "gethostbyname", "create_connection"):
        monkeypatch.setattr(socket, name, refuse)


@pytest.mark.usefixtures("no_network")
def test_only_the_run_directory_is_written_and_nobody_is_called(
    tmp_path: Path, small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, variable in (("home", "HOME"), ("tmp", "TMPDIR")):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(variable, str(tmp_path / name))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    before = {path: path.stat().st_mtime_ns for path in small_recording.iterdir()}
    command = ("run", small_recording, "--pose-graph", "--rerun", "save", "--pcd", "--odometry", "constant-velocity")
    assert lidarslam(*command, "--out", tmp_path / "run").exit_code == 0
    assert lidarslam("evaluate", tmp_path / "run").exit_code == 0
    assert lidarslam("view", tmp_path / "run", "--picture", tmp_path / "run" / "map.png").exit_code == 0
    compared = ("compare", small_recording, "--methods", "constant-velocity+map")
    assert lidarslam(*compared, "--out", tmp_path / "compared").exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["compared", "here", "home", "run", "tmp"]
    assert [path for name in ("here", "home", "tmp") for path in (tmp_path / name).rglob("*")] == []
    assert {path: path.stat().st_mtime_ns for path in small_recording.iterdir()} == before


def test_rerun_is_told_not_to_report(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    assert lidarslam("config").exit_code == 0
    assert os.environ.get("CI")
    assert "FORCE_RERUN_ANALYTICS" not in os.environ


def test_names_in_a_recording_do_not_steer_the_terminal(tmp_path: Path, small_recording: Path) -> None:
    source = tmp_path / "e\x1b]0;owned\x07\u202e\nnote  all is well"
    source.mkdir()
    np.save(source / "000000.npy", np.load(small_recording / "000000.npy"))
    result = lidarslam("info", source)
    assert result.exit_code == 0
    assert "\x1b" not in result.stdout
    assert "\\x1b]0;owned\\x07\\u202e\\nnote" in result.stdout
    assert not [line for line in result.stdout.splitlines() if line.startswith("note  all is well")]
