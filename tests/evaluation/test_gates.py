"""Quality gates: their grammar, what they are applied to, and what they say."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.assessment.evaluate import EvaluateRequest, evaluate
from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.comparison.comparison import MethodResult, SequenceComparison
from lidarslam.evaluation.comparison.gates import (
    FIGURES,
    PATHS,
    Gate,
    format_gates,
    judge,
    judge_comparison,
    parse_gate,
)

from ..conftest import lidarslam, write_run

LOST = 2


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of 120 m whose every other pose is 3 cm aside, and on which two scans were lost."""
    stamps = 0.1 * np.arange(240)
    T = exp(np.multiply.outer(stamps, [0.0, 0.0, 0.02, 5.0, 0.0, 0.0]))
    Trajectory(stamps, T).save(tmp_path / "truth.tum")
    T = T.copy()
    T[::2, 1, 3] += 0.06
    folder = write_run(tmp_path / "run", Trajectory(stamps, T), source="nowhere")
    (folder / "summary.json").write_text(f'{{"scans": 240, "lost_scans": {LOST}, "realtime_factor": null}}')
    return folder


@pytest.mark.parametrize(
    ("text", "gate"),
    [
        ("ate=0.1", Gate("max", "ate", 0.1)),
        ("f_score_0.1=90", Gate("max", "f_score_0.1", 90.0)),
        ("segments.25.translation_percent=1e0", Gate("max", "segments.25.translation_percent", 1.0)),
        ("learned@0.5+map:ate=0.1", Gate("max", "ate", 0.1, "learned@0.5+map")),
        ("a = b: c:lost=0", Gate("max", "lost", 0.0, "a = b: c")),
    ],
)
def test_the_grammar(text, gate):
    assert parse_gate("max", text, with_method=True) == gate


@pytest.mark.parametrize("text", ["ate", "ate=", "=0.1", "ate=nan", "ate=low", ":ate=1", "lost", ""])
def test_other_forms_are_refused(text):
    with pytest.raises(ConfigError, match=r"expected \[METHOD:\]NAME=VALUE"):
        parse_gate("min", text, with_method=True)
    with pytest.raises(ConfigError, match=r"expected NAME=VALUE"):
        parse_gate("min", "learned:ate=0.1")


def test_the_names_are_keys_of_the_written_files(run):
    """Each figure is found in files as the program writes them."""
    written = evaluate(EvaluateRequest(run, reference=run.parent / "truth.tum")).to_json()
    found = {name for name in (*FIGURES, *PATHS) if Gate("max", name, 0.0).of({"metrics": written}) is not None}
    beyond = {f"kitti.by_length.{m}" for m in range(200, 900, 100)}
    expected = {
        name
        for name in (*FIGURES, *PATHS)
        if (FIGURES.get(name) or PATHS[name]).split("/")[1] in ("trajectory", "association", "kitti", "segments")
        and name.rpartition(".")[0] not in beyond
    }
    assert found == expected


def test_bounds_are_included_and_null_fails():
    figures = {"metrics": {"trajectory": {"ate_rmse_m": 0.1}, "kitti": None}, "summary": {}}
    bounds = [Gate("max", "ate", 0.1), Gate("min", "ate", 0.1), Gate("max", "ate", 0.09), Gate("min", "ate", 0.11)]
    judged = judge([*bounds, Gate("max", "kitti", 9.0), Gate("max", "lost", 9.0)], figures)
    assert [each.passed for each in judged] == [True, True, False, False, False, False]
    text = format_gates(judged)
    assert "kitti  could not be computed  <= 9     FAIL" in text
    assert text.endswith("4 of 6 failed")
    assert format_gates(judged[:2]).endswith("all 2 passed")


def test_a_comparison_is_judged_by_method():
    """The reference has no errors of its own, which is no failure; a method that failed is one."""
    failed = MethodResult("crashed", "failed", "it crashed")
    results = [MethodResult("reference", "ok", lost=np.zeros(3, np.bool_), run="a"), failed]
    sequence = SequenceComparison("site", "site.bag", None, "reference", results)
    gates = [Gate("max", "ate", 1.0), Gate("max", "lost", 0.0), Gate("max", "memory_mb", 100.0, "reference")]
    judged = judge_comparison(gates, [sequence], {"a": {"peak_rss_mb": 80.0}})
    outcome = [(each.where, each.gate.figure, each.passed) for each in judged]
    assert outcome == [
        ("site reference", "lost", True),
        ("site reference", "memory_mb", True),
        ("site crashed", "ate", False),
        ("site crashed", "lost", False),
    ]


def test_the_exit_status_of_evaluate(run):
    command = ["evaluate", run, "--reference", run.parent / "truth.tum"]
    passed = lidarslam(*command, "--max", "ate=0.04", "--max", f"lost={LOST}", "--min", "matched=240")
    assert passed.exit_code == 0
    assert "all 3 passed" in passed.stdout
    (run / "metrics.json").unlink()
    failed = lidarslam(*command, "--max", "ate=0.02", "--max", "lost=2", "--min", "realtime_factor=1")
    assert failed.exit_code == 4
    assert (run / "metrics.json").is_file()
    assert "2 of 3 failed" in failed.stdout
    assert lidarslam(*command, "--max", "aet=0.1").exit_code == 2
