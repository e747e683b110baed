"""Methods as the command line names them, and benchmark files."""

import json
from operator import attrgetter
from pathlib import Path

import pytest

from lidarslam.compare.plan import Benchmark, CompareRequest, fill_request, load_benchmark, parse_method, parse_methods
from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError
from lidarslam.simulation.motion import CARRIERS
from lidarslam.simulation.sensors import SENSORS
from lidarslam.simulation.world import WORLDS

from ..conftest import succeeds

SHIPPED = sorted((Path(__file__).parents[2] / "configs" / "benchmarks").glob("*.yaml"))
RECORDINGS = "title: t\nmethods: [kiss-icp]\nrecordings: [{name: a, source: a}]\n"
TABLE = RECORDINGS + "tables: [{title: x, groups: {g: [a]}, quantities: "


def _filled(path: Path, data: Path | None = None) -> CompareRequest:
    request = CompareRequest(Path("out"), (), parse_methods("kiss-icp"), data=data)
    return fill_request(request, load_benchmark(path))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_file_loads_and_fills_a_request(path):
    request = _filled(path, Path("data"))
    assert request.title
    assert request.tables
    assert all(entry.source.parent.parts[0] == "data" for entry in request.recordings)
    assert f"--benchmark {path.stem}" in path.read_text()
    made = [recording.simulate for recording in load_benchmark(path).recordings if recording.simulate is not None]
    assert {simulate.world for simulate in made} <= set(WORLDS)
    assert {simulate.sensor for simulate in made} <= set(SENSORS)
    assert {simulate.motion for simulate in made} <= set(CARRIERS)


def test_the_published_figures_stand_in_their_columns():
    kitti = next(path for path in SHIPPED if path.name == "kitti.yaml")
    overall, _ = _filled(kitti).tables
    (delora,) = [row for row in overall.published if row.method == "DeLORA"]
    assert delora.values == (3.00, 1.38, 6.05, 2.15, 6.44, 3.00)
    assert list(overall.groups) == ["00-08", "09", "10"]


def test_paths_are_relative_to_the_data(tmp_path):
    (tmp_path / "loam.tum").touch()
    benchmark = Benchmark.model_validate(
        {
            "title": "t",
            "recordings": [
                {"name": "a", "source": "a.bag", "reference": "loam.tum", "reference_map": "a.pcd", "prior": "p.tum"},
                {"name": "b", "simulate": {"world": "hall"}, "reference": "kiss-icp"},
            ],
            "methods": ["kiss-icp", {"name": "fine", "method": "kiss-icp", "set": ["global_map.voxel_size_m=0.1"]}],
            "set": ["reader.rate_hz=20"],
        }
    )
    request = fill_request(CompareRequest(Path("out"), (), (), data=tmp_path), benchmark)
    first, second = request.recordings
    assert (first.source, first.reference_map, first.prior) == tuple(tmp_path / n for n in ("a.bag", "a.pcd", "p.tum"))
    assert first.reference == str(tmp_path / "loam.tum")
    assert (second.source, second.reference) == (tmp_path / "b", "kiss-icp")
    assert fill_request(CompareRequest(Path("out"), (), ()), benchmark).recordings[1].source == Path("out/recordings/b")
    assert [method.name for method in request.methods] == ["kiss-icp", "fine"]
    assert request.methods[1].settings[-1] == "global_map.voxel_size_m=0.1"
    assert request.settings == ("reader.rate_hz=20",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: [", "not YAML"),
        (RECORDINGS + "colour: 1\n", "colour: "),
        ("title: t\nmethods: [kiss-icp]\nrecordings: [{name: a}]\n", "recording a: give either source or simulate"),
        ("title: t\nmethods: [a]\nrecordings: [{name: a, source: a}, {name: a, source: b}]\n", "the same name"),
        (RECORDINGS + "tables: [{title: x, groups: {g: [b]}, quantities: [ate_rmse_m]}]\n", "not listed: b"),
        (TABLE + "[ate]}]\n", "no quantity is called 'ate'"),
        (TABLE + "[ate_rmse_m], published: [{method: m, values: [1, 2], source: s}]}]\n", "'m': expected 1 values, "),
    ],
)
def test_mistakes_are_named_with_the_file(tmp_path, text, message):
    file = tmp_path / "benchmark.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"benchmark\.yaml: ") as error:
        load_benchmark(file)
    assert message in str(error.value)


@pytest.mark.slow
def test_recordings_are_made_and_missing_ones_said(tmp_path):
    file = tmp_path / "small.yaml"
    file.write_text(
        "title: small\nmethods: [kiss-icp@0.5]\n"
        "recordings: [{name: office, simulate: {scans: 4}}, {name: gone, source: gone}]\n"
        "tables: [{title: T, groups: {all: [office, gone]}, quantities: [ate_rmse_m]}]\n"
    )
    said = succeeds("compare", "--benchmark", file, "--out", tmp_path / "out")
    assert "(over 1 of 2)" in said
    assert "left out: gone" in said
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert content["tables"][0]["rows"][0]["cells"][0]["averaged"] == 1
    assert content["sequences"][0]["methods"]["kiss-icp@0.5"]["metrics"]["map"]["chamfer_m"] > 0.0
    assert (tmp_path / "out" / "recordings" / "office" / "ground_truth.tum").is_file()


@pytest.mark.parametrize(("name", "method", "closes_loops"), [
    ("learned+map", "surfels", False), ("prior+loam+graph", "loam", True), ("kiss-icp@0.5+loam", "loam", False),
    ("learned+graph", "off", True),
])  # fmt: skip
@pytest.mark.parametrize("before", ["surfels", "loam", "off"])
def test_the_name_decides_the_mapping(name, method, closes_loops, before):
    config = load_config(None, [f"mapping.method={before}", *parse_method(name).settings])
    assert (config.mapping.method, config.pose_graph.enabled) == (method, closes_loops)


SCENE = {"odometry.kiss_icp.voxel_size_m": None, "odometry.kiss_icp.max_range_m": 13.5}


@pytest.mark.parametrize(("name", "values"), [
    ("kiss-icp@0.5", {"odometry.kiss_icp.voxel_size_m": 0.5}),
    ("kiss-icp@0.25+map", {"odometry.kiss_icp.voxel_size_m": 0.25}),
    ("kiss-icp-no-deskew", {"odometry.kiss_icp.deskew": False}), ("prior+map", {"odometry.method": "external"}),
    ("kiss-icp-no-deskew@scene", {"odometry.kiss_icp.deskew": False, **SCENE}), ("kiss-icp@scene+map", SCENE),
])  # fmt: skip
def test_the_name_decides_the_settings(name, values):
    method = parse_method(name)
    before = ("odometry.kiss_icp.voxel_size_m=0.7", "odometry.kiss_icp.max_range_m=70")
    config = load_config(None, [*before, *method.settings_at(13.5)])
    assert {path: attrgetter(path)(config) for path in values} == values
    assert method.by_scene == ("@scene" in name)
    assert method.needs_prior == name.startswith("prior")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("loam", r"no method is called 'loam'; there are: learned, kiss-icp, kiss-icp-no-deskew, .*prior;"),
        ("kiss-icp+graph+map", "no method is called"),
        ("kiss-icp+map+loam", r"no method is called .* each with \+map or \+loam, with \+graph, or"),
        ("prior@0.5", "only kiss-icp takes a voxel size"),
        ("form@scene", "form has no voxel size"),
        ("imu", r"with a map alone; compare imu\+map or imu\+loam"),
        ("learned+imu", r"with a map alone; compare learned\+imu\+map"),
    ],
)
def test_what_is_no_method_is_refused_in_words(name, message):
    with pytest.raises(ConfigError, match=message):
        parse_method(name)


@pytest.mark.parametrize("size", ["fine", "nan", "-1"])
def test_a_voxel_size_is_checked_like_the_setting(size):
    with pytest.raises(ConfigError, match="voxel_size_m"):
        load_config(None, parse_method(f"kiss-icp@{size}").settings)


@pytest.mark.parametrize(("names", "message"), [("kiss-icp,kiss-icp", "named twice"), (" , ", "no method is named")])
def test_a_list_names_each_method_once(names, message):
    with pytest.raises(ConfigError, match=message):
        parse_methods(names)
