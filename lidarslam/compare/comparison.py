"""A comparison: every method on every recording, each in its own process; one result for all."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from lidarslam.compare.methods.process import MethodRun
from lidarslam.compare.methods.run import COMMAND, finished_before, obstacle, run_method
from lidarslam.compare.metrics import measure
from lidarslam.compare.plan import PlannedRecording, make_plan
from lidarslam.compare.request import CompareRequest
from lidarslam.compare.side_by_side import run_side_by_side
from lidarslam.compare.text import format_result
from lidarslam.core.errors import OutputError
from lidarslam.core.files import only_writer
from lidarslam.core.text import count
from lidarslam.evaluation.comparison.comparison import Comparison, MethodResult, SequenceComparison
from lidarslam.evaluation.comparison.mean_table import mean_table
from lidarslam.run.machine import machine, versions
from lidarslam.storage.comparison_folder import COMPARISON, REPORT_HTML, REPORT_MD
from lidarslam.storage.directory import RunDirectory

_INTERRUPTED = "the comparison was interrupted before its turn"

Counter = Callable[[int, int], None]
"""Called with the number of the scan just finished, from 1, and how many there are."""


@dataclass(frozen=True)
class Narrator:
    """Progress: `counting` for the time of one method, by its name; `tell` with a line for each finished method."""

    counting: Callable[[str], AbstractContextManager[Counter]]
    tell: Callable[[str], None]


@dataclass(frozen=True)
class CompareOutcome:
    """A comparison, and whether Ctrl-C ended it early."""

    comparison: Comparison
    interrupted: bool

    @property
    def is_empty(self) -> bool:
        """Whether no method came to any result."""
        results = [result for sequence in self.comparison.sequences for result in sequence.methods]
        return all(result.trajectory is None for result in results)


def compare(request: CompareRequest, narrator: Narrator, command: Sequence[str] = COMMAND) -> CompareOutcome:
    """Run, evaluate, and write comparison.json and the report.

    A method that fails is a row; Ctrl-C ends the method at work, and the results so far are written.

    Args:
        request: recordings, methods, limits.
        narrator: of the progress.
        command: the process of each method, see `run_method`.

    Raises:
        LidarSlamError: the sources, the configuration or the output directory are not usable.
    """
    from lidarslam.evaluation.report.report import render_html, render_markdown

    recordings, missing = make_plan(request)
    try:
        request.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{request.out}: cannot be written ({error.strerror or error})") from error
    turns, directory = _Turns(request, narrator, command), RunDirectory(request.out)
    sequences: list[SequenceComparison] = []
    with only_writer(request.out):
        if not request.where.is_serial:
            turns.take_together(recordings)
        for planned in recordings:
            sequences.append(turns.measured(planned))
            if len(recordings) > 1:
                RunDirectory(request.out / planned.name).write_json(COMPARISON, sequences[-1].to_json())
        names = [sequence.sequence for sequence in sequences]
        comparison = Comparison(
            title=request.title or f"Comparison on {names[0] if len(names) == 1 else f'{len(names)} recordings'}",
            command=request.command,
            sequences=sequences,
            versions=versions(),
            machine=machine(),
            tables=[mean_table(table, sequences) for table in request.tables],
            missing=missing,
            notes=["interrupted: some methods ended early or were not run"] if turns.interrupted else [],
        )
        directory.write_json(COMPARISON, comparison.to_json())
        directory.write_text(REPORT_HTML, render_html(comparison))
        directory.write_text(REPORT_MD, render_markdown(comparison))
    return CompareOutcome(comparison, turns.interrupted)


@dataclass
class _Turns:
    """Each method's turn, until one is interrupted."""

    request: CompareRequest
    narrator: Narrator
    command: Sequence[str]
    interrupted: bool = False
    # of those that ran side by side, by their directories
    _done: dict[Path, MethodResult] = field(default_factory=dict)

    def take_together(self, recordings: Sequence[PlannedRecording]) -> None:
        """Run all methods on all recordings side by side."""
        wanted = [(planned, run) for planned in recordings for run in planned.runs if self._has_to_run(planned, run)]
        scans = [len(range(len(p.recording))[p.entry.start : p.entry.stop : p.entry.step]) for p, _ in wanted]
        counted = 0

        def take(index: int, result: MethodResult) -> None:
            nonlocal counted
            counted += scans[index]
            counter(counted, sum(scans))
            planned, run = wanted[index]
            self._done[run.request.out] = result
            self.narrator.tell(format_result(planned.name, result))

        runs = [run for _, run in wanted]
        if not runs:
            return
        with self.narrator.counting(f"{count(len(runs), 'run')} side by side") as counter:
            self.interrupted = run_side_by_side(runs, self.request.limits, self.command, self.request.where, take)

    def _has_to_run(self, planned: PlannedRecording, run: MethodRun) -> bool:
        is_reused = self.request.reuse and finished_before(run) is not None
        return not is_reused and obstacle(run, planned.recording) is None

    def measured(self, planned: PlannedRecording) -> SequenceComparison:
        """All methods on one recording, with their errors."""
        results = []
        for run in planned.runs:
            if run.request.out in self._done:
                results.append(self._done[run.request.out])
                continue
            earlier = finished_before(run) if self.request.reuse and not self.interrupted else None
            results.append(earlier or self._run(planned, run))
            self.narrator.tell(format_result(planned.name, results[-1], reused=earlier is not None))
        try:
            return measure(planned, results, with_maps=not self.interrupted)
        except KeyboardInterrupt:  # maps take a while
            self.interrupted = True
            return measure(planned, results, with_maps=False)

    def _run(self, planned: PlannedRecording, run: MethodRun) -> MethodResult:
        if self.interrupted:
            return MethodResult(run.name, "not run", _INTERRUPTED)
        if (why := obstacle(run, planned.recording)) is not None:
            return MethodResult(run.name, "not run", why)
        try:
            with self.narrator.counting(f"{planned.name} {run.name}") as counter:
                result, self.interrupted = run_method(run, self.request.limits, counter, self.command)
        except KeyboardInterrupt:  # between two looks at the process
            self.interrupted = True
            return MethodResult(run.name, "not run", _INTERRUPTED)
        return result
