"""Entry points of another package: the example of CONTRIBUTING.md, through the command line."""

import json
import os
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from lidarslam.commands.options import take_config
from lidarslam.commands.runs import run
from lidarslam.compare.plan import parse_methods
from lidarslam.core import plugins
from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import transform_points
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.registry import choose_reader
from lidarslam.storage.finished_run import load_map

from ..conftest import lidarslam, succeeds

GUIDE = Path(__file__).parents[2] / "CONTRIBUTING.md"


def _install(folder: Path, package: str, groups: dict[str, dict[str, str]]) -> None:
    lines = [f"[{group}]\n" + "".join(f"{name} = {at[name]}\n" for name in at) for group, at in groups.items()]
    about = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("\n".join(lines))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, installed."""
    folder = tmp_path_factory.mktemp("site")
    section = GUIDE.read_text().partition("## Plug-ins")[2]
    (code,), (table,) = (re.findall(rf"```{kind}\n(.*?)```", section, re.DOTALL) for kind in ("python", "toml"))
    (folder / "lidarslam_example.py").write_text(code)
    _install(folder, "lidarslam-example", tomllib.loads(table)["project"]["entry-points"])
    return folder


@contextmanager
def _on_path(folder: Path) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        _forget()
        yield folder
    _forget()


def _forget() -> None:
    plugins.search.cache_clear()
    plugins.usable.cache_clear()


@pytest.fixture
def example(site: Path) -> Iterator[Path]:
    with _on_path(site):
        yield site


@pytest.fixture
def broken(example: Path, tmp_path: Path) -> Iterator[Path]:
    """A second package, which takes a built-in name, and cannot be imported."""
    groups = {f"lidarslam.{group}": {"broken": f"no_such_module:{group}"} for group in get_args(plugins.Group)}
    groups["lidarslam.odometry"] |= {"kiss-icp": "lidarslam_example:Still"}
    _install(tmp_path / "other", "lidarslam-broken", groups)
    with _on_path(tmp_path / "other") as folder:
        yield folder


def test_a_run_takes_odometry_mapping_and_metric(example, recording, tmp_path):
    out = tmp_path / "run"
    chosen = ("--odometry", "still", "--mapping", "chain", "--set", "checkpoints.every_scans=1", "--no-report")
    result = lidarslam("run", recording, "--out", out, *chosen)
    assert result.exit_code == 3, result.output  # its map shows that the sensor did move
    np.testing.assert_array_equal(read_tum(out / "trajectory.tum").T_world_lidar, np.tile(np.eye(4), (5, 1, 1)))
    assert "height: mean_m" in result.output
    assert json.loads((out / "metrics.json").read_text())["plugins"]["height"]["mean_m"] >= 0.0
    warnings = json.loads((out / "summary.json").read_text())["warnings"]
    assert any("the mapping cannot save its state" in warning for warning in warnings)


def test_a_mapping_corrects_an_added_odometry(example, recording, tmp_path, room):
    out = tmp_path / "run"
    succeeds("run", recording, "--out", out, "--odometry", "still", "--no-report")
    truth = read_tum(recording / "ground_truth.tum")
    moved = read_tum(out / "trajectory.tum").positions
    far, expected = (np.linalg.norm(positions - positions[0], axis=1) for positions in (moved, truth.positions[:5]))
    np.testing.assert_allclose(far, expected, atol=0.02)
    points = transform_points(truth.T_world_lidar[0], load_map(out).points)
    assert np.percentile(room.distance_to_surface(points), 95) < 0.1


def test_a_source_is_recognised(example, room_scans, tmp_path):
    source = tmp_path / "sweeps"
    source.mkdir()
    for index, scan in enumerate(room_scans[:3]):
        scan.points.tofile(source / f"{index}.sweep")
    described = json.loads(succeeds("info", source, "--json"))
    assert (described["reader"], described["scans"]) == ("sweeps", 3)
    assert choose_reader(source, "sweeps") == "sweeps"
    lidarslam("run", source, "--reader", "sweeps", "--out", tmp_path / "run", "--odometry", "still", "--no-report")
    assert len(read_tum(tmp_path / "run" / "trajectory.tum")) == 3


@pytest.mark.long
def test_a_peer_is_compared(example, recording, tmp_path):
    result = lidarslam("compare", recording, "--out", tmp_path / "compared", "--methods", "origin,still")
    methods = json.loads((tmp_path / "compared" / "comparison.json").read_text())["methods"]
    assert methods["origin"]["status"] == "lost", result.output  # for the same reason
    assert methods["still"]["metrics"]["plugins"]["height"] == methods["origin"]["metrics"]["plugins"]["height"]
    assert "origin: height: mean_m" in result.output
    assert [method.peer for method in parse_methods("origin,still+map+graph")] == ["origin", None]


def test_evaluate_has_the_metric_and_gates_of_it(example, recording, tmp_path):
    truth = recording / "ground_truth.tum"
    files = (truth, "--reference", truth, "--out", tmp_path / "metrics.json")
    said = succeeds("evaluate", *files, "--max", "plugins.height.mean_m=1e-6")
    assert re.search(r"^height +mean_m ", said, re.MULTILINE)
    assert json.loads((tmp_path / "metrics.json").read_text())["plugins"]["height"]["mean_m"] < 1e-6
    assert lidarslam("evaluate", *files, "--min", "plugins.height.mean_m=1").exit_code == 4


def test_without_the_package_nothing_is_added(recording, tmp_path):
    assert lidarslam("run", recording, "--odometry", "still").exit_code == 2
    with pytest.raises(ConfigError, match="there are: learned"):
        parse_methods("still")
    succeeds("evaluate", recording / "ground_truth.tum", "--reference", recording, "--out", tmp_path / "m.json")
    assert "plugins" not in json.loads((tmp_path / "m.json").read_text())


def test_what_cannot_be_imported_is_one_line_with_the_package(broken, recording, tmp_path, caplog):
    cannot = "'broken' of the package lidarslam-broken cannot be loaded"
    for option in ("odometry", "mapping", "reader"):
        result = lidarslam("run", recording, "--out", tmp_path / "run", f"--{option}", "broken")
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
        assert f"the {option} {cannot} (ModuleNotFoundError" in result.stderr
    with pytest.raises(ConfigError, match=f"the peer {cannot}"):
        parse_methods("broken")
    files = ("--reference", recording, "--out", tmp_path / "metrics.json")
    succeeds("evaluate", recording / "ground_truth.tum", *files)
    assert list(json.loads((tmp_path / "metrics.json").read_text())["plugins"]) == ["height"]
    assert f"the metric {cannot}" in caplog.text


def test_names_are_listed_and_a_built_in_one_is_not_taken(broken, recording, caplog):
    assert "|learned+imu|broken|still]" in "".join(lidarslam("run", "--help").output.split())
    assert "the odometry 'kiss-icp' of lidarslam-broken is ignored: the name is taken" in caplog.text
    result = lidarslam("run", recording, "--set", "odometry.method=loam")
    assert "there are: learned, kiss-icp, constant-velocity, imu, learned+imu, external, broken, still" in result.stderr


def test_names_that_are_built_in_need_no_search(recording, monkeypatch):
    def search(point: plugins.PlugPoint) -> None:
        raise AssertionError(point)

    monkeypatch.setattr(plugins, "search", search)
    context = run.make_context("run", [str(recording), "--odometry", "kiss-icp", "--mapping", "loam", "--out", "run"])
    assert take_config(context.params, recording).odometry.method == "kiss-icp"
    assert parse_methods("kiss-icp@0.5,learned+map,small-gicp@scene")
