"""Packets without the libraries that decode them: one line that says what to install."""

import sys

import pytest

from lidarslam.core.errors import ConfigError
from lidarslam.datasets.registry import open_recording


@pytest.mark.parametrize(
    ("name", "module", "remedy"),
    [
        ("drive.pcap", "velodyne_decoder", r"pip install 'lidarslam\[velodyne\]'"),
        ("drive.osf", "ouster", "pip install --no-deps ouster-sdk"),
    ],
)
def test_what_to_install(tmp_path, monkeypatch, name, module, remedy):
    for loaded in [loaded for loaded in sys.modules if loaded.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"packets")
    with pytest.raises(ConfigError, match=rf"{module} is not installed, which packets of an? \w+ need; {remedy}"):
        open_recording(tmp_path / name)
