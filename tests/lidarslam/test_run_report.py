"""The page and the pictures of one run: left by run and evaluate, drawn from its files, never in its way."""

import json
import re
import shutil
from base64 import b64decode, b64encode
from hashlib import sha256
from html import unescape
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.errors import InputError
from lidarslam.evaluation.comparison.comparison import MethodResult
from lidarslam.storage.finished_run import run_directories
from lidarslam.viewer.run_report import leave_report

from ..conftest import succeeds

PAGE = ("report.html", "map.png", "trajectory.png")
FAST = ("--odometry", "constant-velocity")
NO_ERRORS = MethodResult("run", "ok")


def there(run: Path) -> list[str]:
    return [name for name in PAGE if (run / name).exists()]


def figures(html: str) -> list[str]:
    return re.findall(r"<figcaption><b>Figure \d+\. (.*?)\.</b>", html)


def test_a_run_leaves_a_page_with_its_picture_its_errors_and_what_was_changed(whole_run):
    assert there(whole_run) == list(PAGE)
    for name in PAGE[1:]:
        pixels = np.asarray(o3d.io.read_image(str(whole_run / name)))
        assert pixels.shape[1] == 1600
        assert (pixels < 250).any()
    html = (whole_run / "report.html").read_text()
    (embedded,) = re.findall(r'<img src="data:image/png;base64,([\w+/=]+)"', html)
    assert b64decode(embedded) == (whole_run / "map.png").read_bytes()
    assert figures(html)[:3] == ["Map and trajectory", "Trajectories", "Absolute errors"]
    assert "Registration over time" in figures(html)
    text = unescape(re.sub(r"<script.*?</script>|<[^>]+>", "", html, flags=re.DOTALL))
    assert "odometry.methodconstant-velocity (default learned)" in text
    assert "6 ok, 0 degraded, 0 lost" in text
    metrics = json.loads((whole_run / "metrics.json").read_text())
    assert f"{metrics['trajectory']['ate_rmse_m']:.3f}" in text


def test_the_page_runs_its_own_scripts_alone_and_fetches_nothing(whole_run):
    html = (whole_run / "report.html").read_text()
    allowed = re.search(r"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src([^\"]*)", html)
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    hashes = {f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts}
    assert set(allowed[1].split()) == hashes
    outside = re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", outside)


def test_a_run_can_do_without_and_takes_an_earlier_page_away(finished_run, small_recording):
    succeeds("run", small_recording, "--out", finished_run, *FAST, "--no-report", "--overwrite")
    assert there(finished_run) == []


def test_a_page_that_finds_a_folder_in_its_place_is_a_warning(finished_run, caplog):
    (finished_run / "report.html").unlink()
    (finished_run / "report.html").mkdir()
    succeeds("evaluate", finished_run)
    assert "no report.html was drawn: " in caplog.text
    assert "is a folder" in caplog.text
    assert json.loads((finished_run / "metrics.json").read_text())["trajectory"] is not None


def test_an_interruption_ends_the_drawing_alone(finished_run, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lidarslam.viewer.run_report.render_run", interrupted)
    assert leave_report(finished_run, NO_ERRORS) is False


def test_evaluate_draws_the_page_again_with_the_errors(finished_run):
    (finished_run / "report.html").unlink()
    for option in ("--no-report", f"--out={finished_run.parent / 'elsewhere.json'}"):
        succeeds("evaluate", finished_run, option)
    assert not (finished_run / "report.html").exists()
    succeeds("evaluate", finished_run, "--reference-map", finished_run / "map.ply")
    shown = figures((finished_run / "report.html").read_text())
    assert {"Absolute errors", "Error components", "Map errors"} <= set(shown)


def test_bands_show_where_tracking_was_degraded_and_lost_and_a_run_may_have_no_map(finished_run):
    for name in ("map.ply", *PAGE):
        (finished_run / name).unlink()
    title, *rows = (finished_run / "scans.csv").read_text().splitlines()
    statuses = ("ok", "degraded", "degraded", "ok", "lost", "ok")
    changed = [row.replace(",ok,", f",{status},", 1) for row, status in zip(rows, statuses, strict=True)]
    (finished_run / "scans.csv").write_text("\n".join([title, *changed]) + "\n")
    assert leave_report(finished_run, NO_ERRORS)
    assert there(finished_run) == ["report.html", "trajectory.png"]
    html = (finished_run / "report.html").read_text()
    assert '<img src="data:' not in html
    assert "Absolute errors" not in figures(html)
    plots = map(json.loads, re.findall(r'<script type="application/json">(.*?)</script>', html, re.DOTALL))
    bands = next(plot["layout"]["shapes"] for plot in plots if plot["layout"].get("shapes"))
    assert [band["fillcolor"] for band in bands] == ["#e69f00", "#d4003c"]
    np.testing.assert_allclose([[band["x0"], band["x1"]] for band in bands], [[0.1, 0.3], [0.4, 0.5]], atol=1e-6)


def test_the_status_of_a_run_of_which_much_is_unconstrained_is_not_ok(finished_run):
    summary = json.loads((finished_run / "summary.json").read_text())
    (finished_run / "summary.json").write_text(json.dumps(summary | {"unconstrained_m": 0.9 * summary["length_m"] + 1}))
    assert leave_report(finished_run, NO_ERRORS)
    html = (finished_run / "report.html").read_text()
    assert "unreliable" in html
    assert "of its path are hardly constrained" in html


def test_the_runs_of_a_comparison_are_found_from_its_folder(tmp_path, whole_run):
    methods = {"a": {"run": "room/a"}, "b": {"run": "room/b"}, "failed": {"run": None}}
    for name in "ab":
        shutil.copytree(whole_run, tmp_path / "room" / name)
    (tmp_path / "comparison.json").write_text(json.dumps({"sequence": "room", "methods": methods}))
    expected = [tmp_path / "room" / "a", tmp_path / "room" / "b"]
    assert run_directories(tmp_path) == expected
    assert run_directories(whole_run) == [whole_run]
    succeeds("view", tmp_path, "--picture", tmp_path / "maps.png")
    assert (tmp_path / "maps.png").is_file()
    # One of several recordings: its folder has the same content, and its runs lie in it.
    shutil.move(tmp_path / "comparison.json", tmp_path / "room" / "comparison.json")
    assert run_directories(tmp_path / "room") == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"sequences": [{"sequence": "north"}, {"sequence": "south"}]}', "several recordings.*name one of .*north"),
        ('{"methods": {"a": {"run": null}}}', "none of its methods came to a result"),
        ("no json", "not a comparison"),
        ('{"methods": {"a": {"run": "../../x"}}}', r"comparison\.json: not a comparison"),
        ('{"methods": {"a": {"run": "/etc"}}}', r"comparison\.json: not a comparison"),
        ('{"sequences": [5]}', r"comparison\.json: not a comparison"),
    ],
)
def test_a_comparison_that_cannot_be_drawn_says_why(tmp_path, content, message):
    (tmp_path / "comparison.json").write_text(content)
    with pytest.raises(InputError, match=message):
        run_directories(tmp_path)
