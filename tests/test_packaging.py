"""The wheel: complete also when it is built from the source distribution, with links that hold on a package index."""

import os
import re
import subprocess
import sys
import tarfile
from email import message_from_bytes
from pathlib import Path
from zipfile import ZipFile

import pytest

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    folder = tmp_path_factory.mktemp("built")
    build = [sys.executable, "-m", "hatchling", "build", "--directory", str(folder)]
    subprocess.run([*build, "--target", "sdist"], cwd=REPOSITORY, check=True, capture_output=True, timeout=120)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as sources:
        sources.extractall(folder, filter="data")
    unpacked = folder / archive.name.removesuffix(".tar.gz")
    subprocess.run([*build, "--target", "wheel"], cwd=unpacked, check=True, capture_output=True, timeout=120)
    return ZipFile(next(folder.glob("*.whl")))


@pytest.mark.long
def test_everything_below_the_package_is_in_the_wheel(wheel):
    walked = os.walk(REPOSITORY / "lidarslam", followlinks=True)
    files = {Path(folder, name).relative_to(REPOSITORY).as_posix() for folder, _, names in walked for name in names}
    expected = {name for name in files if "__pycache__" not in name}
    assert {name for name in wheel.namelist() if ".dist-info/" not in name} == expected
    assert "lidarslam/odometry/weights/correlation/columns.onnx" in expected
    assert "lidarslam/evaluation/report/templates/report.html.j2" in expected


def test_an_editable_install_is_a_path_as_type_checkers_need(tmp_path):
    build = "import sys; from hatchling.build import build_editable; build_editable(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=REPOSITORY, check=True, capture_output=True, timeout=60)
    built = ZipFile(next(tmp_path.glob("*.whl")))
    (pointer,) = (name for name in built.namelist() if name.endswith(".pth"))
    assert built.read(pointer).decode().split() == [str(REPOSITORY)]
    assert (REPOSITORY / "lidarslam" / "py.typed").is_file()


def test_links_of_the_description_are_absolute_and_lead_to_files(wheel):
    (metadata,) = (name for name in wheel.namelist() if name.endswith("/METADATA"))
    description = message_from_bytes(wheel.read(metadata)).get_payload()
    links = re.findall(r"\]\(([^)]+)\)", str(description))
    assert links
    here = re.compile(r"https://(?:raw\.githubusercontent|github)\.com/lidarslam/lidarslam/(?:blob/)?main/([^#]+)")
    for link in links:
        assert link.startswith("https://") or link.startswith("#"), link
        inside = here.match(link)
        assert inside is None or (REPOSITORY / inside[1]).exists(), link
