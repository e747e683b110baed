"""Compiled loops work, and go on working when nothing can be kept on disk, or what is kept is damaged or outdated."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.caching import InTreeCacheLocator, UserWideCacheLocator
from numpy.typing import NDArray

from lidarslam.core import compiled as compiled_module
from lidarslam.core.compiled import compiled, is_compiled, prefetch

SOURCE = """
from lidarslam.core.compiled import compiled

@compiled
def total(values):
    total = 0.0
    for value in values:
        total += value
    return total
"""
CALLEE = """
from lidarslam.core.compiled import compiled

@compiled
def factor(value):
    return {factor} * value
"""
CALLER = """
from lidarslam.core.compiled import compiled
from callee import factor

@compiled
def scaled(value):
    return factor(value)
"""

PART = CALLEE.replace("import compiled", "import compiled_part").replace("@compiled", "@compiled_part")

Load = Callable[[str, str], ModuleType]


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    """Write a module, and load it as a new process would."""
    monkeypatch.syspath_prepend(tmp_path)

    def write_and_load(name: str, source: str) -> ModuleType:
        file = tmp_path / f"{name}.py"
        if not file.exists() or file.read_text() != source:
            file.write_text(source)
        module = ModuleType(name)
        monkeypatch.setitem(sys.modules, name, module)
        # Python's own cache goes by whole seconds.
        exec(compile(source, str(file), "exec"), module.__dict__)
        return module

    return write_and_load


def loaded_from_disk(function: Any) -> int:
    return sum(function.stats.cache_hits.values())


def total_and_hits(module: ModuleType) -> tuple[float, int]:
    return module.total(np.arange(4.0)), loaded_from_disk(module.total)


def kept(folder: Path) -> list[Path]:
    return sorted(folder.glob("__pycache__/*.nb[ic]"))


def test_computes_and_is_kept_for_the_next_process(load, tmp_path):
    assert total_and_hits(load("sums", SOURCE)) == (6.0, 0)
    assert kept(tmp_path)
    assert total_and_hits(load("sums", SOURCE)) == (6.0, 1)


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_costs_time_only_and_is_made_anew(load, tmp_path, ending):
    load("sums", SOURCE).total(np.arange(4.0))
    damaged = [file for file in kept(tmp_path) if file.suffix == f".{ending}"]
    assert damaged
    for file in damaged:
        file.write_bytes(b"\x80\x04broken")
    assert total_and_hits(load("sums", SOURCE)) == (6.0, 0)
    assert total_and_hits(load("sums", SOURCE)) == (6.0, 1)


def test_a_full_disk_costs_time_only(load, tmp_path, monkeypatch):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    module = load("sums", SOURCE)
    monkeypatch.setattr(module.total._cache._cache_file, "save", full)
    assert module.total(np.arange(4.0)) == 6.0
    assert not kept(tmp_path)


def test_numba_may_be_switched_off():
    thinned = "one_per_cell(np.eye(3), 9.0), central_per_cell(np.eye(3), 9.0)"
    code = f"from lidarslam.core.thinning import *; import numpy as np; print({thinned})"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[2] [0]", done.stderr


@compiled
def prefetched(values: NDArray[np.float64], rows: NDArray[np.int64]) -> float:
    total = 0.0
    for row in rows:
        prefetch(values, row)
        if 0 <= row < len(values):
            total += values[row, 1]
    return total


@pytest.mark.parametrize("step", [1, 2, -1])
def test_any_row_of_any_array_may_be_prefetched(step):
    """One that is none, too: nothing is read but into the cache."""
    values = np.arange(60.0).reshape(10, 6)[::step, 1:]
    rows = np.array([0, 3, -1, 10, 1 << 40, -(1 << 40), 4])
    assert prefetched(values, rows) == values[[0, 3, 4], 1].sum()


@pytest.mark.parametrize("callee", [CALLEE, PART])
def test_a_change_of_what_is_called_outdates_what_calls(load, callee):
    for factor in (2.0, 10.0):
        load("callee", callee.format(factor=factor))
        assert load("caller", CALLER).scaled(3.0) == 3.0 * factor
    load("callee", callee.format(factor=10.0))
    unchanged = load("caller", CALLER)
    assert unchanged.scaled(3.0) == 30.0
    assert loaded_from_disk(unchanged.scaled) == 1


def test_a_module_is_compiled_once_all_its_functions_are_on_disk(load):
    source = SOURCE + "@compiled\ndef least(values):\n    return min(values[0], values[1])\n"
    module = load("sums", source)
    assert not is_compiled(module)
    module.total(np.arange(4.0))
    assert not is_compiled(module)
    module.least(np.arange(4.0))
    assert is_compiled(module)
    assert is_compiled(load("sums", source))
    assert not is_compiled(load("sums", f"{source}# changed"))


@pytest.fixture
def unprivileged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The installation is read-only; the folder that the user can write."""
    folder = tmp_path / "cache"

    def refuse(_: InTreeCacheLocator) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(InTreeCacheLocator, "ensure_cache_path", refuse)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder))
    return folder


@pytest.fixture
def installed(load: Load) -> None:
    """Compiled by who installed it."""
    load("sums", SOURCE).total(np.arange(4.0))


def test_an_installation_that_cannot_be_written_is_not_compiled_anew(installed, unprivileged, load):
    module = load("sums", SOURCE)
    assert is_compiled(module)
    assert total_and_hits(module) == (6.0, 1)
    assert module.total(np.arange(4)) == 6  # of other types: kept by the user
    assert sum(1 for _ in unprivileged.rglob("*.nbc")) == 1
    again = load("sums", SOURCE)
    assert (again.total(np.arange(4)), loaded_from_disk(again.total)) == (6, 1)
    changed = load("sums", SOURCE + "# changed")
    assert not is_compiled(changed)
    assert total_and_hits(changed) == (6.0, 0)


def test_who_compiles_anew_at_every_start_is_told_so_once(installed, unprivileged, load, monkeypatch, caplog):
    monkeypatch.setattr(numba.config, "CACHE_DIR", os.devnull)
    monkeypatch.setattr(UserWideCacheLocator, "ensure_cache_path", InTreeCacheLocator.ensure_cache_path)
    monkeypatch.setattr(compiled_module, "_temporary_folder", lambda: "")
    compiled_module._warn_of_compiling_anew.cache_clear()
    warning = "set NUMBA_CACHE_DIR to a folder that can be written"
    module = load("sums", SOURCE)
    assert total_and_hits(module) == (6.0, 1)  # compiled by who installed it
    assert warning not in caplog.text
    assert module.total(np.arange(4)) == 6
    assert load("more", SOURCE).total(np.arange(4.0)) == 6.0
    assert is_compiled(load("more", SOURCE))  # other processes need not compile what they cannot keep
    assert caplog.text.count(warning) == 1


@pytest.mark.long
def test_a_user_without_a_home_keeps_code_in_a_temporary_folder(tmp_path):
    (tmp_path / "sums.py").write_text(SOURCE)
    (tmp_path / "__pycache__").write_text("a file, where no folder can be made")
    (tmp_path / "tmp").mkdir()
    code = "import numpy, sums; sums.total(numpy.arange(4.0)); print(sum(sums.total.stats.cache_hits.values()))"
    environment = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment |= {"HOME": os.devnull, "TMPDIR": str(tmp_path / "tmp")}
    environment["PYTHONPATH"] = f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}"
    command = [sys.executable, "-c", code]
    runs = [subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)]
    assert [int(done.stdout) for done in runs] == [0, 1]
