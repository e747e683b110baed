"""Configurations and benchmarks by name, anywhere."""

import re
from pathlib import Path

import pytest

from lidarslam.config.settings import BENCHMARKS, CONFIGS, Config, dump_yaml, headline, load_config, shipped_files

from ..conftest import lidarslam

ROOT = Path(__file__).parents[2]
FILES = [*shipped_files(CONFIGS).values(), *shipped_files(BENCHMARKS).values()]


pytestmark = pytest.mark.usefixtures("empty_folder")


def test_every_file_of_the_repository_has_a_name():
    assert CONFIGS.parent.name == "lidarslam"  # the part of the repository that is installed
    assert {path.resolve() for path in FILES} == set((ROOT / "configs").rglob("*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_begins_with_a_line_about_it_and_an_example_by_its_name(path):
    assert re.fullmatch(r"# .{20,118}\.", path.read_text().splitlines()[0])
    assert f"--config {path.stem}\n" in path.read_text() or f"--benchmark {path.stem}" in path.read_text()


def test_a_configuration_is_found_by_its_name():
    expected = dump_yaml(load_config(CONFIGS / "indoor.yaml"))
    assert expected != dump_yaml(Config())
    assert lidarslam("config", "-c", "indoor").stdout == expected


def test_a_path_is_a_file_of_the_user(empty_folder):
    for name in ("indoor", "indoor.yaml", "mine"):
        (empty_folder / name).write_text("global_map: {voxel_size_m: 0.77}\n")
    for path in ("./indoor", "indoor.yaml", "mine", empty_folder / "indoor"):
        assert "voxel_size_m: 0.77" in lidarslam("config", "-c", path).stdout
    assert "voxel_size_m: 0.77" not in lidarslam("config", "-c", "indoor").stdout


def test_config_lists_them_with_what_they_are_and_what_they_need():
    listed = lidarslam("config", "--list").stdout
    for path in FILES:
        assert re.search(rf"^  {path.stem} +{re.escape(headline(path))}$", listed, re.MULTILINE)
    assert "--data: the root of the KITTI odometry benchmark, with sequences/NN and poses/NN.txt" in listed
    assert f"The files are in {CONFIGS}\n" in listed


def test_a_benchmark_without_its_data_says_what_it_needs():
    refused = lidarslam("compare", "--benchmark", "kitti")
    assert refused.exit_code == 1
    assert "none of its recordings is in the current folder; --data is the root of the KITTI" in refused.stderr
    elsewhere = lidarslam("compare", "--benchmark", "kitti", "--data", "/nowhere")
    assert "none of its recordings is in /nowhere; --data is the root" in elsewhere.stderr
