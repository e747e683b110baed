"""What is named in place of a recording, or needs a library that is missing, and what the error says about it."""

import sys
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.datasets.registry import choose_reader, open_recording

SYNC = "2011_09_26_drive_0005_sync"


def write(*paths: Path, content: bytes = b"-") -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def refused(source: Path) -> str:
    with pytest.raises(InputError) as error:
        choose_reader(source)
    return str(error.value)


def scans(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for index in range(3):
        np.zeros((4, 4), dtype="<f4").tofile(folder / f"{index:06d}.bin")
    return folder


@pytest.mark.parametrize("name", ["", "map.ply", "trajectory.tum"])
def test_a_run_is_no_recording_and_its_recording_is_named(tmp_path: Path, name: str) -> None:
    write(tmp_path / "run" / "map.ply", tmp_path / "run" / "trajectory.tum")
    write(tmp_path / "run" / "config.yaml", content=b"run:\n  version: 0.1.0\n  source: /data/office.mcap\nreader:\n")
    said = refused(tmp_path / "run" / name)
    assert "not a recording; its recording is /data/office.mcap." in said
    assert f"lidarslam view {tmp_path / 'run'} shows it" in said


def test_neither_a_merge_nor_a_comparison_is_a_recording(tmp_path: Path) -> None:
    write(tmp_path / "map.ply", tmp_path / "pose_graph.g2o")
    write(tmp_path / "config.yaml", content=b"run:\n  version: 0.1.0\n  sources:\n  - a\n\n# Settings\nreader:\n")
    assert f"is a merge directory, not a recording. lidarslam view {tmp_path} shows it" in refused(tmp_path)
    write(tmp_path / "compared" / "comparison.json")
    assert "is a comparison, not a recording" in refused(tmp_path / "compared")


def test_a_bag_in_the_folder_of_a_run_is_a_recording(tmp_path: Path) -> None:
    write(tmp_path / "site.mcap", tmp_path / "trajectory.tum")
    write(tmp_path / "config.yaml", content=b"run:\n  version: 0.1.0\n")
    assert choose_reader(tmp_path / "site.mcap") == "rosbag"


def test_the_drives_of_a_date_are_named(tmp_path: Path) -> None:
    drives = [scans(tmp_path / "2011_09_26" / name / "velodyne_points" / "data").parents[1] for name in (SYNC, "other")]
    for folder in (tmp_path / "2011_09_26", tmp_path):
        said = refused(folder)
        assert "holds 2 recordings (kitti-raw); name one: " in said
        assert all(str(drive) in said for drive in drives)
    assert f"lies in a recording (kitti-raw); name that: {drives[0]}" in refused(drives[0] / "velodyne_points")
    assert f"name {drives[0]} for its times" in open_recording(drives[0] / "velodyne_points" / "data").warnings[0]


def test_recordings_in_a_folder_are_named(tmp_path: Path) -> None:
    write(tmp_path / "bags" / "a.bag", tmp_path / "bags" / "b.pcap")
    assert "holds 2 recordings (rosbag); name one: " in refused(tmp_path / "bags")
    inner = scans(tmp_path / "outer" / "middle" / "inner")
    assert f"holds the recording {inner} (scan-folder); name that" in refused(tmp_path / "outer")


def test_a_bag_beside_it_is_not_what_a_folder_belongs_to(tmp_path: Path) -> None:
    write(tmp_path / "other.mcap", tmp_path / "images" / "0.png")
    assert "holds .png files" in refused(tmp_path / "images")


@pytest.mark.parametrize("name", ["drive.zip", "0.csv", "path.tum"])
def test_files_that_no_reader_takes_are_told_by_their_endings(tmp_path: Path, name: str) -> None:
    write(tmp_path / "folder" / name)
    assert f"folder: holds {Path(name).suffix} files, not a recording" in refused(tmp_path / "folder")
    assert f"{name}: not a recording" in refused(tmp_path / "folder" / name)


def test_a_name_that_is_misspelt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "recordings" / "office").mkdir(parents=True)
    assert f"did you mean {tmp_path / 'recordings' / 'office'}?" in refused(tmp_path / "recordings" / "ofice")
    said = refused(tmp_path / "recording" / "office")
    assert f"there is no {tmp_path / 'recording'}; did you mean {tmp_path / 'recordings'}?" in said
    assert "is an address; download" in refused(Path("https://example.org/a.bag"))
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    assert refused(tmp_path / "link").endswith(f"link to {tmp_path / 'gone'}, which is not there")
    monkeypatch.chdir(tmp_path)
    assert refused(Path("record")).startswith("record: no such file or folder; did you mean recordings?")


@pytest.mark.parametrize(
    ("name", "module", "remedy"),
    [
        ("drive.pcap", "velodyne_decoder", r"pip install 'lidarslam\[velodyne\]'"),
        ("drive.osf", "ouster", "pip install --no-deps ouster-sdk"),
    ],
)
def test_packets_without_the_library_that_decodes_them_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str, remedy: str
) -> None:
    for loaded in [loaded for loaded in sys.modules if loaded.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, module, None)
    write(tmp_path / name, content=b"packets")
    with pytest.raises(ConfigError, match=rf"{module} is not installed, which packets of an? \w+ need; {remedy}"):
        open_recording(tmp_path / name)
