"""Benchmark files: those that are shipped, and what a file can get wrong."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from lidarslam.cli import main
from lidarslam.compare.benchmark import Benchmark, fill_request, load_benchmark
from lidarslam.compare.methods.names import parse_methods
from lidarslam.compare.request import CompareRequest
from lidarslam.core.errors import ConfigError
from lidarslam.simulation.motion import CARRIERS
from lidarslam.simulation.sensors import SENSORS
from lidarslam.simulation.world import WORLDS

SHIPPED = sorted((Path(__file__).parents[2] / "configs" / "benchmarks").glob("*.yaml"))


def _filled(path: Path, data: Path | None = None) -> CompareRequest:
    request = CompareRequest(Path("out"), (), parse_methods("kiss-icp"))
    return fill_request(request, load_benchmark(path), data)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_file_loads_and_fills_a_request(path: Path) -> None:
    request = _filled(path, Path("data"))
    assert request.title
    assert request.tables
    assert all(entry.source.parent.parts[0] == "data" for entry in request.recordings)
    assert f"--benchmark {path.stem}" in path.read_text()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_method_exists_or_is_still_to_come(path: Path) -> None:
    names = [method if isinstance(method, str) else method.method for method in load_benchmark(path).methods]
    refused = list(filter(None, map(_refusal, names)))
    assert all("is not part of this version" in reason for reason in refused)


def _refusal(name: str) -> str | None:
    try:
        parse_methods(name)
    except ConfigError as error:
        return str(error)
    return None


def test_shipped_simulations_name_what_there_is() -> None:
    made = [recording.simulate for path in SHIPPED for recording in load_benchmark(path).recordings]
    made = [simulate for simulate in made if simulate is not None]
    assert made
    assert {simulate.world for simulate in made} <= set(WORLDS)
    assert {simulate.sensor for simulate in made} <= set(SENSORS)
    assert {simulate.motion for simulate in made} <= set(CARRIERS)


def test_the_published_figures_stand_in_their_columns() -> None:
    kitti = next(path for path in SHIPPED if path.name == "kitti.yaml")
    overall, by_sequence = _filled(kitti).tables
    (delora,) = [row for row in overall.published if row.method == "DeLORA"]
    assert [cell.value for cell in delora.cells] == [3.00, 1.38, 6.05, 2.15, 6.44, 3.00]
    assert list(overall.groups) == ["00-08", "09", "10"]
    (kiss,) = [row for row in by_sequence.published if row.method == "KISS-ICP"]
    assert kiss.cells[list(by_sequence.groups).index("08")].value == 0.82


def test_paths_are_relative_to_the_data(tmp_path: Path) -> None:
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
    request = fill_request(CompareRequest(Path("out"), (), ()), benchmark, tmp_path)
    first, second = request.recordings
    assert (first.source, first.reference_map, first.prior) == tuple(tmp_path / n for n in ("a.bag", "a.pcd", "p.tum"))
    assert first.reference == str(tmp_path / "loam.tum")
    assert (second.source, second.reference) == (tmp_path / "b", "kiss-icp")
    assert fill_request(request, benchmark, None).recordings[1].source == Path("out/recordings/b")
    assert [method.name for method in request.methods] == ["kiss-icp", "fine"]
    assert request.methods[1].settings[-1] == "global_map.voxel_size_m=0.1"
    assert request.settings == ("reader.rate_hz=20",)


RECORDINGS = "title: t\nmethods: [kiss-icp]\nrecordings: [{name: a, source: a}]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: [", "not YAML"),
        ("title: t\nmethods: [kiss-icp]\n", "recordings: Field required"),
        (RECORDINGS + "colour: 1\n", "colour: Extra inputs are not permitted"),
        ("title: t\nmethods: [kiss-icp]\nrecordings: [{name: a}]\n", "recording a: give either source or simulate"),
        ("title: t\nmethods: [a]\nrecordings: [{name: a, source: a}, {name: a, source: b}]\n", "the same name"),
        (RECORDINGS + "tables: [{title: x, groups: {g: [b]}, quantities: [ate_rmse_m]}]\n", "not listed: b"),
        (RECORDINGS + "tables: [{title: x, groups: {g: [a]}, quantities: [ate]}]\n", "no quantity is called 'ate'"),
        (
            RECORDINGS
            + "tables: [{title: x, groups: {g: [a]}, quantities: [ate_rmse_m],"
            + " published: [{method: m, values: [1, 2], source: s}]}]\n",
            "row 'm': expected 1 values, one for each group and quantity, got 2",
        ),
    ],
)
def test_mistakes_are_named_with_the_file(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "benchmark.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"benchmark\.yaml: ") as error:
        load_benchmark(file)
    assert message in str(error.value)


def test_a_method_that_is_not_there_can_be_replaced(tmp_path: Path) -> None:
    file = tmp_path / "benchmark.yaml"
    file.write_text("title: t\nmethods: [loam]\nrecordings: [{name: a, source: a}]\n")
    with pytest.raises(ConfigError, match="can be replaced with --methods"):
        fill_request(CompareRequest(Path("out"), (), ()), load_benchmark(file), None)
    assert _filled(file).methods == parse_methods("kiss-icp")


def test_recordings_are_made_and_missing_ones_said(tmp_path: Path) -> None:
    file = tmp_path / "small.yaml"
    file.write_text(
        "title: small\nmethods: [kiss-icp@0.5]\n"
        "recordings:\n"
        "  - {name: office, simulate: {scans: 4}}\n"
        "  - {name: gone, source: gone}\n"
        "tables: [{title: T, groups: {all: [office, gone]}, quantities: [ate_rmse_m]}]\n"
    )
    command = ["compare", "--benchmark", str(file), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert "(over 1 of 2)" in result.stdout
    assert "left out: gone" in result.stdout
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert content["tables"][0]["rows"][0]["cells"][0]["averaged"] == 1
    assert content["sequences"][0]["methods"]["kiss-icp@0.5"]["metrics"]["map"]["chamfer_m"] > 0.0
    assert (tmp_path / "out" / "recordings" / "office" / "ground_truth.tum").is_file()
