"""A comparison: every method on every recording, one after another, each in its own process; one result for all."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from evaluation.comparison.comparison import Comparison, MethodResult, SequenceComparison
from evaluation.comparison.mean_table import mean_table
from lidarslam.compare.method_run import COMMAND, MethodTask, collect, finished_before, run_method
from lidarslam.compare.metrics import measure
from lidarslam.compare.plan import COMPARISON, REPORT_HTML, REPORT_MD, Plan, PlannedRecording, make_plan
from lidarslam.compare.request import CompareRequest
from lidarslam.compare.text import format_result
from lidarslam.core.errors import OutputError
from lidarslam.core.files import only_writer
from lidarslam.run.directory import RunDirectory
from lidarslam.run.machine import machine, versions

_INTERRUPTED = "the comparison was interrupted before its turn"

Counter = Callable[[int, int], None]
"""Told the number of the scan just finished, from 1, and how many there are."""


@dataclass(frozen=True)
class Narrator:
    """Who is told how the comparison goes.

    Attributes:
        counting: for the time of one method, given its name.
        tell: a line a finished method.
    """

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

    What a method dies of is its row; Ctrl-C ends the method at work, and what there is is written.

    Args:
        request: what is compared.
        narrator: told how it goes.
        command: what is started for each method, see `run_method`.

    Raises:
        LidarSlamError: the sources, the configuration or the output directory are not usable.
    """
    plan = make_plan(request)
    try:
        request.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{request.out}: cannot be written ({error.strerror or error})") from error
    turns = _Turns(request, narrator, command)
    sequences = []
    with only_writer(request.out):
        for planned in plan.recordings:
            sequence = turns.measured(planned)
            sequences.append(sequence)
            if len(plan.recordings) > 1:
                RunDirectory(request.out / planned.name).write_json(COMPARISON, sequence.to_json())
        comparison = _assemble(request, plan, sequences, turns.interrupted)
        write_comparison(comparison, RunDirectory(request.out))
    return CompareOutcome(comparison, turns.interrupted)


@dataclass
class _Turns:
    """Each method's turn, until one is interrupted."""

    request: CompareRequest
    narrator: Narrator
    command: Sequence[str]
    interrupted: bool = False

    def measured(self, planned: PlannedRecording) -> SequenceComparison:
        """All methods on one recording, with their errors; those of the maps take a while."""
        results = self.take(planned)
        try:
            return measure(planned, results, with_maps=not self.interrupted)
        except KeyboardInterrupt:
            self.interrupted = True
            return measure(planned, results, with_maps=False)

    def take(self, planned: PlannedRecording) -> list[MethodResult]:
        """The results of all methods on one recording."""
        results = []
        for task in planned.tasks:
            earlier = finished_before(task) if self.request.reuse and not self.interrupted else None
            results.append(self._run(planned.name, task) if earlier is None else collect(task, earlier))
            self.narrator.tell(format_result(planned.name, results[-1], reused=earlier is not None))
        return results

    def _run(self, recording: str, task: MethodTask) -> MethodResult:
        if self.interrupted:
            return MethodResult(task.name, "not run", _INTERRUPTED)
        try:
            with self.narrator.counting(f"{recording} {task.name}") as counter:
                result, self.interrupted = run_method(task, self.request.limits, counter, self.command)
        except KeyboardInterrupt:  # between two looks at the process
            self.interrupted = True
            return MethodResult(task.name, "not run", _INTERRUPTED)
        return result


def write_comparison(comparison: Comparison, directory: RunDirectory) -> None:
    """Write comparison.json and the report, as a page and as text."""
    from evaluation.report.report import render_html, render_markdown

    directory.write_json(COMPARISON, comparison.to_json())
    directory.write_text(REPORT_HTML, render_html(comparison))
    directory.write_text(REPORT_MD, render_markdown(comparison))


def _assemble(
    request: CompareRequest, plan: Plan, sequences: Sequence[SequenceComparison], interrupted: bool
) -> Comparison:
    names = [sequence.sequence for sequence in sequences]
    return Comparison(
        title=request.title or f"Comparison on {names[0] if len(names) == 1 else f'{len(names)} recordings'}",
        command=request.command,
        sequences=sequences,
        versions=versions(),
        machine=machine(),
        published=request.published,
        tables=[mean_table(table, sequences) for table in request.tables],
        missing=plan.missing,
        notes=["interrupted: some methods ended early or were not run"] if interrupted else [],
    )
