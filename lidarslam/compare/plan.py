"""Everything that can be known to be wrong with a comparison before the first method is run."""

from dataclasses import dataclass
from pathlib import Path

from evaluation.comparison.comparison import MissingRecording
from lidarslam.compare.method_run import PROCESS, MethodTask
from lidarslam.compare.methods import Method
from lidarslam.compare.request import CompareRequest, RecordingEntry
from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.run import directory as files
from lidarslam.run.request import RunRequest

# In the comparison's folder; each recording's folder holds its own comparison.json.
COMPARISON, REPORT_HTML, REPORT_MD = "comparison.json", "report.html", "report.md"
# Beside the recordings' folders: recordings that a benchmark has made.
RECORDINGS = "recordings"


@dataclass(frozen=True, eq=False)
class PlannedRecording:
    """One recording and what is to be run on it.

    Attributes:
        name: unique in the comparison; of its folder too.
        entry: what was asked for.
        recording: open.
        tasks: one a method.
    """

    name: str
    entry: RecordingEntry
    recording: Recording
    tasks: tuple[MethodTask, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """The recordings that are there, and those that are not."""

    recordings: tuple[PlannedRecording, ...]
    missing: tuple[MissingRecording, ...]


def make_plan(request: CompareRequest) -> Plan:
    """Open every recording and resolve every configuration.

    Raises:
        InputError: a recording is not there and may not be skipped, or none is.
        ConfigError: a setting, a reference or a prior does not fit.
        OutputError: the folder holds a comparison already, or is none.
    """
    planned: list[PlannedRecording] = []
    missing: list[MissingRecording] = []
    for entry in request.recordings:
        try:
            planned.append(_plan_recording(request, entry, {other.name for other in planned}))
        except InputError as error:
            if not request.skip_missing:
                raise
            missing.append(MissingRecording(entry.name or entry.source.name, str(entry.source), str(error)))
    if not planned:
        raise InputError(f"none of the {len(missing)} recordings can be read; {missing[0].reason}")
    _check_folder(request, planned)
    return Plan(tuple(planned), tuple(missing))


def _check_entry(entry: RecordingEntry, methods: tuple[Method, ...]) -> None:
    """Refuse a prior or a reference that does not fit the methods.

    Raises:
        ConfigError: a method needs a prior and there is none, or the reference is no method and no file.
    """
    wanting = [method.name for method in methods if method.needs_prior]
    if wanting and entry.prior is None:
        raise ConfigError(f"{wanting[0]}: takes its motions from a trajectory; give one with --prior FILE")
    names = [method.name for method in methods]
    if entry.reference is not None and entry.reference not in names and not Path(entry.reference).is_file():
        raise ConfigError(f"reference {entry.reference!r}: is neither a file nor one of the methods {', '.join(names)}")


def _plan_recording(request: CompareRequest, entry: RecordingEntry, taken: set[str]) -> PlannedRecording:
    settings = [*request.settings, *entry.settings]
    recording = open_recording(entry.source, load_config(request.config_file, settings).reader)
    if not len(recording):
        raise InputError(f"{entry.source}: holds no scan")
    _check_entry(entry, request.methods)
    name = _unused(entry.name or recording.name, taken)
    tasks = []
    for method in request.methods:
        config = load_config(request.config_file, [*settings, *method.settings])
        folder = request.out / name / method.name
        prior = entry.prior if method.needs_prior else None
        run = RunRequest(entry.source, folder, config, start=entry.start, stop=entry.stop, step=entry.step, prior=prior)
        tasks.append(MethodTask(method.name, run, f"{name}/{method.name}"))
    return PlannedRecording(name, entry, recording, tuple(tasks))


def _unused(name: str, taken: set[str]) -> str:
    """A name that can be a folder's, and no other recording's: 04, 04-2, 04-3, ..."""
    name = name.replace("/", "-").lstrip(".") or "recording"
    candidates = [name, *(f"{name}-{number}" for number in range(2, len(taken) + 3))]
    return next(candidate for candidate in candidates if candidate not in taken | {RECORDINGS})


def _check_folder(request: CompareRequest, planned: list[PlannedRecording]) -> None:
    out = request.out
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: a file is in the way; name another directory")
    for recording in planned:
        if out.resolve() == recording.entry.source.resolve():
            raise OutputError(f"{out}: is the recording itself; name another directory for the comparison")
    if request.overwrite or request.reuse:
        return
    folders = [task.run.out for recording in planned for task in recording.tasks]
    marks = [out / COMPARISON, *(folder / name for folder in folders for name in (PROCESS, files.CONFIG))]
    found = next((mark for mark in marks if mark.exists()), None)
    if found is not None:
        raise OutputError(
            f"{out}: holds a comparison already ({found.relative_to(out)}); name another directory, take what is"
            " finished of it with --reuse, or replace it with --overwrite"
        )
