"""`lidarslam datasets`: the table, and what is found on disk."""

import json
import sys
from pathlib import Path

import pytest
from click.testing import Result

from lidarslam.datasets.published.catalogue import CATALOGUE
from lidarslam.datasets.registry import READERS

from ...conftest import lidarslam


@pytest.fixture(autouse=True)
def nothing_downloaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """evalio's data folder is empty, and so is the current one."""
    monkeypatch.setenv("EVALIO_DATA", str(tmp_path / "published"))
    monkeypatch.chdir(tmp_path)


def _line(result: Result, name: str) -> str:
    return next(line for line in result.output.splitlines() if line.startswith(f"{name} "))


def test_every_reader_exists_and_every_name_is_one_word() -> None:
    assert {one.reader for one in CATALOGUE} <= set(READERS)
    assert len({one.name for one in CATALOGUE}) == len(CATALOGUE)
    assert all(one.name.replace("_", "").isalnum() and one.url.startswith("https://") for one in CATALOGUE)


def test_evalios_data_sets_are_those_of_evalio() -> None:
    datasets = pytest.importorskip("evalio.datasets")
    known = datasets.all_datasets()
    listed = {one.name: one for one in CATALOGUE if one.reader == "evalio"}
    assert set(listed) == set(known)
    assert {name: one.url for name, one in listed.items()} == {name: known[name].url() for name in known}


def test_the_list_counts_recordings_on_disk(tmp_path: Path) -> None:
    (tmp_path / "published" / "hilti_2022" / "basement_2").mkdir(parents=True)
    (tmp_path / "disk" / "kitti" / "2011_09_26" / "drive_a" / "velodyne_points" / "data").mkdir(parents=True)
    (tmp_path / "disk" / "other" / "sequences").mkdir(parents=True)
    result = lidarslam("datasets", "disk")
    assert result.exit_code == 0
    assert _line(result, "hilti_2022").endswith("yes  1 recording")
    assert _line(result, "kitti_raw").endswith("1 recording")
    assert _line(result, "kitti_odometry").endswith("1 recording")
    assert _line(result, "boreas").endswith("-")
    assert _line(lidarslam("datasets"), "kitti_raw").endswith("-")


def test_one_data_set_has_sequences_and_commands(tmp_path: Path) -> None:
    pytest.importorskip("evalio")
    downloaded = tmp_path / "published" / "hilti_2022" / "basement_2"
    downloaded.mkdir(parents=True)
    lines = {line[:11].strip(): line[11:] for line in lidarslam("datasets", "hilti_2022").output.splitlines()[1:]}
    assert lines["download"] == "evalio dl hilti_2022/construction_upper_level_1"
    assert lines["run"] == "lidarslam run evalio:hilti_2022/construction_upper_level_1"
    assert lines["sensor"] == "Hesai PandarXT-32"
    assert str(downloaded) in lidarslam("datasets", "evalio:hilti_2022").output


def test_without_evalio_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evalio", None)
    output = lidarslam("datasets", "oxford_spires").output
    assert "pip install 'lidarslam[datasets]'" in output
    assert "evalio dl oxford_spires/SEQUENCE" in output


def test_json_has_all_facts(tmp_path: Path) -> None:
    folder = tmp_path / "drive_a"
    (folder / "velodyne_points" / "data").mkdir(parents=True)
    content = {one["name"]: one for one in json.loads(lidarslam("datasets", "--json", "drive_a").output)}
    assert len(content) == len(CATALOGUE)
    assert content["kitti_raw"]["on_disk"] == [str(folder)]
    assert content["enwide"]["truth"] == "total station, positions alone"
    (one,) = json.loads(lidarslam("datasets", "kitti_raw", "--json").output)
    assert one["on_disk"] == []


def test_the_page_has_the_same_table() -> None:
    page = (Path(__file__).parents[3] / "docs" / "data_sets.md").read_text(encoding="utf-8")
    for one in CATALOGUE:
        cells = [f"[{one.title}]({one.url})", f"`{one.name}`", one.sensor, f"`{one.reader}`", one.truth]
        assert f"| {' | '.join([*cells, 'yes' if one.imu else 'no', one.tried])} |" in page
