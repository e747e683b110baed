"""The configuration: closed, typed, and clear about what is wrong; YAML gives plain values or an error in a line."""

import re
from pathlib import Path
from typing import get_args

import pytest

from lidarslam.config.settings import (
    BENCHMARKS,
    CONFIGS,
    Config,
    TrainConfig,
    dump_yaml,
    headline,
    load_config,
    load_train_config,
    parse_yaml,
    reader_settings,
    shipped_files,
)
from lidarslam.core.errors import ConfigError
from lidarslam.mapping.config import MappingConfig, MappingName

from .conftest import lidarslam


@pytest.mark.parametrize("path", shipped_files(CONFIGS).values(), ids=lambda path: path.name)
def test_every_shipped_file_loads_and_differs_from_the_defaults(path):
    if path.name.startswith("train_"):
        assert load_train_config(path) != TrainConfig()
    else:
        assert load_config(path) != Config()


def test_settings_win_over_the_file(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("odometry: {kiss_icp: {voxel_size_m: 0.5, max_range_m: 40}}\n")
    config = load_config(file, ["odometry.kiss_icp.voxel_size_m=0.25"])
    assert config.odometry.kiss_icp.voxel_size_m == 0.25
    assert config.odometry.kiss_icp.max_range_m == 40.0


@pytest.mark.parametrize("method", get_args(MappingName))
def test_every_mapping_is_a_word_also_off_and_is_dumped_so_that_it_loads_again(tmp_path, method):
    file = tmp_path / "config.yaml"
    for text in (f"mapping: {{method: {method}}}", dump_yaml(Config(mapping=MappingConfig(method=method)))):
        file.write_text(text)
        mapping = load_config(file).mapping
        assert mapping.method == method
        assert mapping.enabled == (method != "off")


@pytest.mark.parametrize("text", ["04", "it's", "'", "null", "a: b"])
def test_the_readers_options_stay_text(text):
    config = load_config(None, reader_settings(name=None, topic=text, sequence=text))
    assert (config.reader.name, config.reader.topic, config.reader.sequence) == (None, text, text)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["odometry.kiss_icp.voxelsize=1"], r"no odometry\.kiss_icp\.voxelsize; did you mean voxel_size_m\?"),
        (["odometry.colour=1"], r"no odometry\.colour; there are: method"),
        (["odometry.method=loam"], r"odometry\.method: no odometry is called 'loam'; there are: learned, kiss-icp"),
        (["global_map"], r"expected key\.path=value"),
        (["global_map.voxel_size_m=2", "global_map.voxel_size_m.x=1"], "voxel_size_m is a value, not a section"),
        (["odometry=1"], r"^configuration \(--set\): odometry=1: expected a section$"),
        (["global_map.min_range_m=80"], r"^configuration \(--set\): global_map: min_range_m=80 must be less than "),
        (["mapping.tracking.lost_below=0.8"], r"tracking: lost_below=0\.8 must not exceed degraded_below=0\.6,"),
        (["mapping.method=icp"], r"mapping\.method: no mapping is called 'icp'; there are: surfels, loam, off"),
        (["checkpoints.interval_s=.inf"], "finite number"),
        (["mapping.min_range_m=100"], r"mapping: min_range_m=100 must be less than max_range_m=100, or"),
    ],
)
def test_mistakes_are_named(settings, message):
    with pytest.raises(ConfigError, match=message):
        load_config(None, settings)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, 2", "not YAML"),
        ("- 1\n- 2\n", "expected keys and values, got a list"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"#" * (5 << 20), "longer than 4 MB"),
    ],
)
def test_broken_files_are_named(tmp_path, text, message):
    file = tmp_path / "broken.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=message) as error:
        load_config(file)
    assert "broken.yaml" in str(error.value)


def test_the_origin_is_the_one_that_was_given(tmp_path):
    file = tmp_path / "wrong.yaml"
    file.write_text("global_map: {voxel_size_m: -1}\n")
    for settings, origin in (([], file), (["viewer.map_every=3"], f"{file} or --set")):
        with pytest.raises(ConfigError, match=rf"^configuration \({origin}\): .*voxel_size_m=-1"):
            load_config(file, settings)


def test_what_is_dumped_has_comments_and_loads_again_with_the_section_on_the_run(tmp_path):
    file, printed = tmp_path / "config.yaml", dump_yaml(Config())
    for config in (Config(), load_config(None, ["reader.sequence='04'", "global_map.voxel_size_m=0.3"])):
        file.write_text(dump_yaml(config, {"version": "0.1.0", "source": "somewhere"}))
        assert load_config(file) == config
    assert "\n# Saving for --resume\ncheckpoints:\n  interval_s: 10.0   # least time between" in printed


def test_plain_values():
    text = "a: {b: [1, 2.5, null, yes]}\nbase: &base {x: 1}\nc:\n  <<: *base\n  x: 2\n"
    assert parse_yaml(text) == {"a": {"b": [1, 2.5, None, True]}, "base": {"x": 1}, "c": {"x": 2}}


@pytest.mark.parametrize("text", ["010", "0x10", "0o10", "0b11", "1:30", "1:30.5", "1_000", "1.", "7e3", "-0"])
def test_a_number_is_decimal_or_a_text(text):
    """In YAML 1.1, 010 is eight and 1:30 ninety."""
    numbers = {"1.": 1.0, "-0": 0}
    assert parse_yaml(text) == numbers.get(text, text)
    assert parse_yaml(f"'{text}'") == text


@pytest.mark.parametrize(("text", "message"), [
    ("a: {b: 1, b: 2}", "the key 'b' occurs twice"),
    ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
    ("a: 2021-13-45", "not YAML: month must be"), ("a: " + "[" * 3_000 + "]" * 3_000, "not YAML: maximum recursion"),
    ("a: \x00", "not YAML"), ("? [a]\n: 1", "unhashable key"),
])  # fmt: skip
def test_anything_else_is_an_error_in_one_line(text, message):
    with pytest.raises(ConfigError, match=message) as raised:
        parse_yaml(text)
    assert "\n" not in str(raised.value)


ROOT = Path(__file__).parents[1]
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


@pytest.mark.parametrize("name", [name for name in shipped_files(CONFIGS) if name.startswith("train_")])
def test_the_configuration_of_a_training_is_printed_as_well(tmp_path, name):
    file = tmp_path / "printed.yaml"
    file.write_text(lidarslam("config", "--train", "-c", name, "--set", "training.batch=3").stdout)
    assert load_train_config(file) == load_train_config(CONFIGS / f"{name}.yaml", ["training.batch=3"])


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
