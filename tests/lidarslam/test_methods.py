"""Methods as the command line names them."""

import pytest

from lidarslam.compare.methods.names import parse_method, parse_methods
from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError


def test_a_plain_name_sets_the_odometry_and_switches_mapping_off() -> None:
    config = load_config(None, parse_method("kiss-icp").settings)
    assert config.odometry.method == "kiss-icp"
    assert config.odometry.kiss_icp.voxel_size_m is None
    assert config.mapping.enabled is False


def test_map_overrules_a_configuration_either_way() -> None:
    assert load_config(None, ["mapping.method=off", *parse_method("kiss-icp+map").settings]).mapping.enabled
    assert not load_config(None, ["mapping.method=loam", *parse_method("kiss-icp").settings]).mapping.enabled


@pytest.mark.parametrize(
    ("name", "method", "closes_loops"),
    [
        ("learned", "off", False),
        ("learned+map", "surfels", False),
        ("learned+loam", "loam", False),
        ("constant-velocity+loam", "loam", False),
        ("prior+loam+graph", "loam", True),
        ("kiss-icp@0.5+loam", "loam", False),
        ("learned+graph", "off", True),
    ],
)
@pytest.mark.parametrize("before", ["surfels", "loam", "off"])
def test_the_name_decides_the_mapping(name: str, method: str, closes_loops: bool, before: str) -> None:
    config = load_config(None, [f"mapping.method={before}", *parse_method(name).settings])
    assert (config.mapping.method, config.pose_graph.enabled) == (method, closes_loops)


@pytest.mark.parametrize(("name", "size_m"), [("kiss-icp@0.5", 0.5), ("kiss-icp@1", 1.0), ("kiss-icp@0.25+map", 0.25)])
def test_a_voxel_size_stands_behind_the_at(name: str, size_m: float) -> None:
    assert load_config(None, parse_method(name).settings).odometry.kiss_icp.voxel_size_m == size_m


@pytest.mark.parametrize("name", ["kiss-icp@scene", "kiss-icp-no-deskew@scene", "kiss-icp@scene+map"])
def test_scene_is_a_range_by_the_size_of_the_scene_and_voxels_of_a_hundredth(name: str) -> None:
    method = parse_method(name)
    before = ("odometry.kiss_icp.voxel_size_m=0.5", "odometry.kiss_icp.max_range_m=70")
    kiss = load_config(None, [*before, *method.settings_at(13.5)]).odometry.kiss_icp
    assert (method.by_scene, kiss.max_range_m, kiss.voxel_size_m) == (True, 13.5, None)
    assert parse_method("kiss-icp").settings_at(13.5) == parse_method("kiss-icp").settings


def test_prior_is_the_external_odometry() -> None:
    method = parse_method("prior+map")
    assert method.needs_prior
    assert load_config(None, method.settings).odometry.method == "external"
    assert not parse_method("kiss-icp").needs_prior


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "loam",
            r"no method is called 'loam'; there are: learned, kiss-icp, kiss-icp-no-deskew, .*prior;",
        ),
        ("external", "no method is called 'external'"),
        ("kiss-icp+mapping", r"no method is called 'kiss-icp\+mapping'"),
        ("kiss-icp+graph+map", "no method is called"),
        ("kiss-icp+map+loam", r"no method is called .* each with \+map or \+loam, with \+graph, or"),
        ("kiss-icp+graph+loam", "no method is called"),
        ("learned+surfels", "no method is called"),
        ("", "no method is called ''"),
        ("prior@0.5", "only kiss-icp takes a voxel size"),
        ("kiss-icp@fine", "expected a voxel size in metres, as in kiss-icp@0.5, got 'fine'"),
        ("learned@scene", "only kiss-icp takes a voxel size"),
        ("form@scene", "form has no voxel size"),
        ("small-gicp@0.5", "no method is called"),
        ("kiss-icp@-1", "expected a voxel size"),
        ("kiss-icp@nan", "expected a voxel size"),
        ("imu", r"measures turns alone; compare imu\+map or imu\+loam"),
        ("learned+imu", r"takes part in scan-to-map registration; compare learned\+imu\+map"),
        ("kiss-icp+imu+map", "no method is called"),
        ("constant-velocity", r"only predicts; compare constant-velocity\+map or constant-velocity\+loam"),
    ],
)
def test_what_is_no_method_is_refused_in_words(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_method(name)


def test_a_list_keeps_its_order_and_its_names() -> None:
    assert [method.name for method in parse_methods(" kiss-icp@0.5, kiss-icp,prior")] == [
        "kiss-icp@0.5",
        "kiss-icp",
        "prior",
    ]


@pytest.mark.parametrize(("names", "message"), [("kiss-icp,kiss-icp", "named twice"), (" , ", "no method is named")])
def test_a_list_names_each_method_once(names: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_methods(names)
