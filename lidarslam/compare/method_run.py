"""One method on one recording: run it in a process of its own, and say what came of it, whatever came of it."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

from evaluation.comparison.comparison import MethodResult, MethodStatus
from lidarslam.compare.method_ending import WHOLE, judge, read_summary
from lidarslam.compare.method_process import encode
from lidarslam.compare.supervised import Limits, supervise
from lidarslam.config.settings import Config, dump_yaml
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import InputError
from lidarslam.core.files import remove_partial_files
from lidarslam.run import directory as files
from lidarslam.run.directory import RunDirectory
from lidarslam.run.finished_run import load_run
from lidarslam.run.request import RunRequest

# Beside a run's own files: how its process went, and what it wrote to standard error.
PROCESS, LOG = "process.json", "process.log"

COMMAND = (sys.executable, "-m", "lidarslam.compare.method_process")
# From here the packages are found first, whatever lies where the user stands.
_ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class MethodTask:
    """What is to be run.

    Attributes:
        name: of the method.
        run: the run; its `out` becomes the run directory.
        shown_run: the run directory as the report links to it.
    """

    name: str
    run: RunRequest
    shown_run: str


@dataclass(frozen=True)
class ProcessRecord:
    """How the process of a method went; the content of process.json."""

    status: MethodStatus
    message: str
    wall_s: float
    peak_rss_mb: float | None


def run_method(
    task: MethodTask, limits: Limits, progress: Callable[[int, int], None], command: Sequence[str] = COMMAND
) -> tuple[MethodResult, bool]:
    """Run the method to whatever end; its result, and whether it was interrupted with Ctrl-C.

    Args:
        task: what is run; an earlier run of a comparison in its directory is replaced.
        limits: memory and time it may take.
        progress: told after every scan its number from 1 and how many there are.
        command: what is started, with the encoded request as its last argument.
    """
    folder = task.run.out
    _clear(folder)
    folder.mkdir(parents=True, exist_ok=True)

    def see(line: str) -> None:
        words = line.split()
        if len(words) == 2 and all(word.isdecimal() for word in words):
            progress(int(words[0]), int(words[1]))

    ending = supervise([*command, encode(task.run)], folder / LOG, limits, see, _ROOT)
    remove_partial_files(folder)
    status, message = judge(ending, folder, folder / LOG, limits)
    record = ProcessRecord(status, message, ending.wall_s, ending.peak_rss_mb)
    RunDirectory(folder).write_json(PROCESS, asdict(record))
    return collect(task, record), ending.cause == "interrupt"


def finished_before(task: MethodTask) -> ProcessRecord | None:
    """How an earlier run of the same task went, if it came to its end.

    The same are the source, its scans, the prior, the program's version and the configuration; not looked at is what
    the source and the prior hold.
    """
    folder = task.run.out
    try:
        record = ProcessRecord(**json.loads((folder / PROCESS).read_text(encoding="utf-8")))
        tree = read_yaml(folder / files.CONFIG)
        was_run = tree.pop(files.RUN_SECTION)
        config = Config.model_validate(tree)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    is_run = {
        "version": version("lidarslam"),
        "source": str(task.run.source.resolve()),
        "start": task.run.start,
        "stop": task.run.stop,
        "step": task.run.step,
        "prior": None if task.run.prior is None else str(task.run.prior.resolve()),
    }
    is_same = config == task.run.config and all(was_run.get(key) == value for key, value in is_run.items())
    return record if is_same and record.status in WHOLE else None


def collect(task: MethodTask, record: ProcessRecord) -> MethodResult:
    """The result of a process, with what its run directory holds; a damaged one counts as a failure."""
    result = MethodResult(
        name=task.name,
        status=record.status,
        message=record.message,
        peak_rss_mb=record.peak_rss_mb,
        wall_s=record.wall_s,
        settings=dump_yaml(task.run.config),
    )
    if record.status not in (*WHOLE, "stopped"):
        return result
    try:
        finished = load_run(task.run.out)
        summary = read_summary(task.run.out)
        ms = {stage: values["median"] for stage, values in summary["ms_per_scan"].items()}
        p95 = summary["ms_per_scan"]["total"]["p95"]
        reasons = tuple(stretch["reason"] for stretch in summary["lost"])
    except (InputError, OSError, ValueError, KeyError) as error:
        return replace(result, status="failed", message=f"its run directory cannot be read: {error}")
    return replace(
        result,
        scans=len(finished.trajectory),
        trajectory=finished.trajectory,
        lost=finished.lost,
        lost_reasons=reasons,
        ms_per_scan_median=ms.pop("total"),
        ms_per_scan_p95=p95,
        stage_ms=ms,
        run=task.shown_run,
    )


def _clear(folder: Path) -> None:
    """Remove what an earlier comparison left in a method's directory, so that nothing is taken for the new run's."""
    if (folder / LOG).is_file():
        for name in (*files.FILES, PROCESS):
            (folder / name).unlink(missing_ok=True)
