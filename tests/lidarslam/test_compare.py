"""Several methods on a recording: what each comes to, be it a crash, and what is written of it; their processes."""

import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lidarslam.compare.comparison import CompareOutcome, compare, format_comparison
from lidarslam.compare.method_run import Ending, Limits, supervise
from lidarslam.compare.plan import CompareRequest, RecordingEntry, parse_methods
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.trajectory import Trajectory

from ..conftest import lidarslam, succeeds, write_recording
from .conftest import Told

Finished = tuple[Path, CompareOutcome]
METRICS = {"association", "trajectory", "kitti", "segments", "map"}

# Started in the place of a method: what it does depends on the voxel size that stands in the method's name.
FAULTS = """
import json, os, sys, time
from pathlib import Path
name = Path(json.loads(sys.argv[-1])["request"]["out"]).name
print("1 5", flush=True)
if name == "kiss-icp@1": os.abort()
if name == "kiss-icp@3": time.sleep(60)
if name == "kiss-icp@4": raise RuntimeError("no such thing")
if name == "kiss-icp@5": raise MemoryError
if name == "kiss-icp@6": os.kill(os.getpid(), 9)
if name == "kiss-icp@7": print("lidarslam: the recording is damaged", file=sys.stderr); sys.exit(1)
os.execv(sys.executable, [sys.executable, "-m", "lidarslam.compare.method_run", *sys.argv[1:]])
"""


@pytest.fixture(scope="module")
def faults(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    file = tmp_path_factory.mktemp("faults") / "faults.py"
    file.write_text(FAULTS)
    return sys.executable, str(file)


def _request(recording: Path, out: Path, methods: str, **changes: Any) -> CompareRequest:
    entry = RecordingEntry(recording, prior=recording / "ground_truth.tum")
    return replace(CompareRequest(out, (entry,), parse_methods(methods)), **changes)


@pytest.fixture(scope="module")
def finished(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    out = tmp_path_factory.mktemp("compared")
    return out, compare(_request(recording, out, "kiss-icp@0.5,prior"), Told())


def test_comparison_json_holds_what_the_contract_names(finished):
    content = json.loads((finished[0] / "comparison.json").read_text())
    assert content["sequence"] == "room"
    assert list(content["methods"]) == ["kiss-icp@0.5", "prior"]
    for method in content["methods"].values():
        assert {"elapsed_ms_per_scan", "latency_ms_p99"} <= set(method)
        assert set(method["metrics"]) == METRICS
        assert method["status"] == "ok"
        assert method["ms_per_scan_median"] > 0.0
        assert method["peak_rss_mb"] > 50.0
        assert method["wall_s"] > 0.1
        assert method["lost_scans"] == 0
    assert content["methods"]["prior"]["metrics"]["trajectory"]["ate_rmse_m"] < 1e-6
    assert content["methods"]["prior"]["metrics"]["map"] is None


def test_every_method_leaves_a_run_directory_and_a_row_of_which_the_best_is_marked(finished):
    out, outcome = finished
    for method in ("kiss-icp@0.5", "prior"):
        files = {"trajectory.tum", "map.ply", "config.yaml", "summary.json", "process.log"}
        assert files <= {path.name for path in (out / "room" / method).iterdir()}
    assert "voxel_size_m: 0.5" in (out / "room" / "kiss-icp@0.5" / "config.yaml").read_text()
    assert all("kiss-icp@0.5" in (out / f"report.{kind}").read_text() for kind in ("html", "md"))
    lines = format_comparison(outcome.comparison, out).splitlines()
    prior = next(line for line in lines if line.startswith("prior"))
    assert lines[0] == "room, against ground truth"
    assert prior.split()[:3] == ["prior", "ok", "0.000*"]
    assert any(line.startswith("look      lidarslam view ") for line in lines)


def test_what_is_finished_is_reused_and_keeps_its_time(finished, recording, told):
    out, before = finished
    with pytest.raises(OutputError, match=r"a comparison already \(comparison.json\); .* --reuse, .* --overwrite"):
        compare(_request(recording, out, "prior"), told)
    none = (sys.executable, "-c", "raise SystemExit('was run again')")
    again = compare(_request(recording, out, "kiss-icp@0.5,prior", reuse=True), told, none)
    first, second = before.comparison.sequences[0], again.comparison.sequences[0]
    assert [method.to_json() for method in second.methods] == [method.to_json() for method in first.methods]
    assert all("in an earlier comparison" in line for line in told.lines)


def test_other_settings_are_run_again_and_leave_nothing_of_the_earlier(finished, recording, tmp_path, told):
    out = Path(shutil.copytree(finished[0], tmp_path / "out"))
    broken = (sys.executable, "-c", "import sys; sys.exit('broken')")
    changed = _request(recording, out, "prior", reuse=True, settings=("global_map.voxel_size_m=0.3",))
    outcome = compare(changed, told, broken)
    (result,) = outcome.comparison.sequences[0].methods
    assert (result.status, result.message, result.trajectory) == ("failed", "broken", None)
    assert outcome.is_empty
    assert {path.name for path in (out / "room" / "prior").iterdir()} == {"process.json", "process.log"}


@pytest.mark.long
def test_whatever_a_method_dies_of_is_its_row(recording, tmp_path, told, faults):
    names = "".join(f"kiss-icp@{number}," for number in (1, 4, 5, 6, 7))
    request = _request(recording, tmp_path, names + "prior", limits=Limits(memory_mb=1000.0))
    outcome = compare(request, told, faults)
    assert [(row.status, row.message) for row in outcome.comparison.sequences[0].methods] == [
        ("failed", "Aborted (signal 6)"),
        ("failed", "RuntimeError: no such thing"),
        ("out of memory", "MemoryError"),
        ("out of memory", "killed by the system (signal 9), as it does when memory runs out"),
        ("failed", "the recording is damaged"),
        ("ok", ""),
    ]
    assert not outcome.is_empty
    content = json.loads((tmp_path / "comparison.json").read_text())
    assert content["methods"]["kiss-icp@1"]["metrics"] is None
    assert "Aborted (signal 6)" in (tmp_path / "report.html").read_text()
    assert "kiss-icp@1: Aborted (signal 6)" in format_comparison(outcome.comparison, tmp_path)


@pytest.mark.long
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_the_method_at_work_and_writes_what_there_is(recording, tmp_path, told, faults):
    def interrupt() -> None:
        while not any(name == "room kiss-icp@3" for name, _, _ in told.counts):
            threading.Event().wait(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    outcome = compare(_request(recording, tmp_path, "prior,kiss-icp@3,kiss-icp"), told, faults)
    assert outcome.interrupted
    assert [row.status for row in outcome.comparison.sequences[0].methods] == ["ok", "not run", "not run"]
    content = json.loads((tmp_path / "comparison.json").read_text())
    assert content["notes"][0].startswith("interrupted")
    assert content["methods"]["prior"]["metrics"]["trajectory"]["ate_rmse_m"] < 1e-6


def _against(reference: str, finished: Finished, recording: Path, told: Told) -> Any:
    """The methods that were compared already, against another reference."""
    entry = RecordingEntry(recording, prior=recording / "ground_truth.tum", reference=reference)
    request = _request(recording, finished[0], "kiss-icp@0.5,prior", recordings=(entry,), reuse=True)
    return compare(request, told).comparison.sequences[0]


def test_a_method_can_be_the_reference_and_has_no_errors_itself(finished, recording, told):
    sequence = _against("prior", finished, recording, told)
    assert sequence.reference_name == "prior"
    kiss, prior = sequence.methods
    assert prior.metrics is None
    assert 0.0 < kiss.metrics.errors.ate_rmse_m < 0.1
    assert any("no truth" in note for note in sequence.notes)


def test_a_file_can_be_the_reference(finished, recording, told, tmp_path, room_truth):
    late = tmp_path / "late.tum"
    Trajectory(room_truth.stamps + 100.0, room_truth.T_world_lidar).save(late)
    assert _against(f"{recording}/ground_truth.tum", finished, recording, told).methods[1].metrics is not None
    prior = _against(str(late), finished, recording, told).methods[1]
    assert prior.metrics is None
    assert "correct the clock" in prior.message


@pytest.mark.long
def test_without_any_reference_there_is_still_a_table(recording, tmp_path, told, room_scans):
    bare = write_recording(tmp_path / "bare", room_scans[:3])
    entry = RecordingEntry(bare, prior=recording / "ground_truth.tum")
    outcome = compare(_request(bare, tmp_path / "out", "prior", recordings=(entry,)), told)
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert content["reference"] is None
    assert content["methods"]["prior"]["metrics"] is None
    assert content["methods"]["prior"]["ms_per_scan_median"] > 0.0
    assert "without ground truth" in " ".join(content["notes"])
    assert not outcome.is_empty


@pytest.mark.long
def test_several_recordings_have_a_file_each_and_one_for_all(recording, tmp_path, told):
    prior = recording / "ground_truth.tum"
    entries = [RecordingEntry(recording, prior=prior, start=start) for start in (2, 1)]
    entries.append(RecordingEntry(tmp_path / "nowhere", name="gone", prior=prior))
    request = _request(recording, tmp_path / "out", "prior", recordings=tuple(entries), skip_missing=True)
    compare(request, told)
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert [sequence["sequence"] for sequence in content["sequences"]] == ["room", "room-2"]
    assert [sequence["methods"]["prior"]["scans"] for sequence in content["sequences"]] == [3, 4]
    assert content["missing"][0]["sequence"] == "gone"
    assert "no such file or folder" in content["missing"][0]["reason"]
    for sequence in content["sequences"]:
        own = json.loads((tmp_path / "out" / sequence["sequence"] / "comparison.json").read_text())
        assert own == sequence


def test_an_interruption_before_any_turn_is_written_for_every_recording(recording, tmp_path, told, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lidarslam.compare.method_run.run_method", interrupted)
    entries = (RecordingEntry(recording), RecordingEntry(recording, start=1))
    outcome = compare(_request(recording, tmp_path, "kiss-icp", recordings=entries), told)
    assert outcome.interrupted
    for name in ("room", "room-2"):
        content = json.loads((tmp_path / name / "comparison.json").read_text())
        assert content["methods"]["kiss-icp"]["status"] == "not run"


def test_mistakes_are_found_before_anything_is_run(recording, tmp_path, told):
    out = tmp_path / "out"
    bare, lost = RecordingEntry(recording), RecordingEntry(tmp_path / "nowhere")
    mistakes: list[tuple[str, tuple[RecordingEntry, ...], bool, str]] = [
        ("kiss-icp,prior", (bare,), False, "give one with --prior FILE"),
        ("kiss-icp", (replace(bare, reference="loam"),), False, "neither a file nor one of the methods kiss-icp"),
        ("kiss-icp", (bare, lost), False, "no such file or folder"),
        ("kiss-icp", (lost,), True, "none of the 1 recordings can be read"),
    ]
    for methods, entries, skip, message in mistakes:
        with pytest.raises((ConfigError, InputError), match=message):
            compare(_request(recording, out, methods, recordings=entries, skip_missing=skip), told)
    assert not out.exists()


def test_a_bound_that_is_not_met_has_a_status_of_its_own(finished, recording):
    command = ["compare", recording, "--out", finished[0], "--methods", "kiss-icp@0.5,prior", "--reuse"]
    command += ["--prior", recording / "ground_truth.tum"]
    passed = succeeds(*command, "--max", "prior:ate=0.001", "--max", "lost=0", "--min", "memory_mb=1")
    assert "all 5 passed" in passed
    failed = lidarslam(*command, "--max", "ate=0.1", "--max", "prior:kitti=1")
    assert failed.exit_code == 4
    assert "room prior         kitti  could not be computed  <= 1    FAIL" in failed.stdout


@pytest.mark.long
def test_a_lost_method_is_a_finding_and_none_at_all_a_failure(recording, tmp_path):
    prior = tmp_path / "short.tum"
    prior.write_text("0.1 0 0 0 0 0 0 1\n0.2 0 0 0 0 0 0 1\n")
    arguments = ["compare", recording, "--methods", "prior", "--prior", prior]
    assert "lost on " in succeeds(*arguments, "--out", tmp_path / "lost")
    none = lidarslam(*arguments, "--out", tmp_path / "none", "--memory-limit-mb", 1)
    assert none.exit_code == 1
    assert "out of memory" in none.stdout
    assert "no method came to a result" in none.stderr


Run = Callable[..., Ending]


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def run(tmp_path: Path, lines: list[str]) -> Run:
    def supervised(code: str, **limits: float) -> Ending:
        return supervise([sys.executable, "-c", code], tmp_path / "log", Limits(**limits), lines.append)

    return supervised


def test_lines_come_through_and_standard_error_is_kept(run, lines, tmp_path):
    ending = run("import sys; print('1 2'); print('2 2'); print('oh', file=sys.stderr); sys.exit(3)")
    assert (ending.cause, ending.status, lines) == ("itself", 3, ["1 2", "2 2"])
    assert (tmp_path / "log").read_text() == "oh\n"


def test_time_and_the_memory_of_all_processes_are_measured(run):
    child = "import time; held = bytearray(100_000_000); held[::4096] = b'x' * len(held[::4096]); time.sleep(0.8)"
    ending = run(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])")
    assert 0.8 < ending.wall_s < 10.0
    assert 100.0 < ending.peak_rss_mb < 300.0


def test_one_that_hangs_is_ended_with_its_children(run, lines, still_runs):
    code = "import subprocess, time; print(subprocess.Popen(['sleep', '60']).pid, flush=True); time.sleep(60)"
    ending = run(code, timeout_s=1.0)
    assert (ending.cause, ending.status) == ("time", -signal.SIGKILL)
    assert ending.wall_s < 10.0
    assert not still_runs(int(lines[0]))


def test_one_that_eats_memory_is_ended(run):
    code = "import time; held = []\nwhile True: held.append(b'x' * 10_000_000); time.sleep(0.02)"
    ending = run(code, memory_mb=150.0, timeout_s=30.0)
    assert ending.cause == "memory"
    assert 150.0 < ending.peak_rss_mb < 2000.0


@pytest.mark.usefixtures("interruptible")
def test_an_interruption_is_passed_on_and_waited_for(run, tmp_path):
    mark = tmp_path / "written"
    code = f"""
import time
try:
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.3)
    open({str(mark)!r}, "w").close()
"""
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert run(code).cause == "interrupt"
    assert mark.exists()
