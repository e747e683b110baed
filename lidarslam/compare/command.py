"""`lidarslam compare` behind its options."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lidarslam.compare.benchmark import fill_request, load_benchmark, make_recordings, require_data
from lidarslam.compare.comparison import CompareOutcome, Narrator, compare
from lidarslam.compare.methods.names import parse_methods
from lidarslam.compare.request import CompareRequest, RecordingEntry
from lidarslam.compare.supervised import Limits
from lidarslam.compare.text import format_comparison
from lidarslam.config.settings import reader_settings
from lidarslam.core.errors import ConfigError
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.core.text import command_line
from lidarslam.evaluation.comparison.gates import Gate, format_gates, judge_comparison, require_methods
from lidarslam.run.interruption import ended_like_interrupted
from lidarslam.run.progress import show_count
from lidarslam.storage.finished_run import read_summary

DEFAULT_METHODS = "learned+map,kiss-icp"

Say = Callable[[str], None]


@dataclass(frozen=True)
class Ending:
    """How a comparison ended."""

    has_results: bool  # whether all methods had their turn and any came to a result
    gates_passed: bool  # whether every bound was met


def run_compare(
    say: Say,
    tell: Say,
    *,
    sources: tuple[Path, ...],
    benchmark: Path | None,
    out: Path,
    methods: str | None,
    data: Path | None,
    prior: Path | None,
    reference: str | None,
    reference_map: Path | None,
    memory_limit_mb: float | None,
    timeout_s: float | None,
    start: int,
    stop: int | None,
    step: int,
    reuse: bool,
    overwrite: bool,
    reader: str | None,
    topic: str | None,
    sequence: str | None,
    config_file: Path | None,
    settings: tuple[str, ...],
    gates: Sequence[Gate] = (),
    where: Where = SERIAL,
) -> Ending:
    """Compare, and print the tables and the gates.

    `say` prints the result and `tell` the progress; for the options see `lidarslam compare --help`.
    """
    if reuse and overwrite:
        raise ConfigError("--reuse keeps what --overwrite replaces; choose one")
    names = methods or (DEFAULT_METHODS if benchmark is None else None)
    entry = RecordingEntry(
        start=start, stop=stop, step=step, prior=prior, reference=reference, reference_map=reference_map
    )
    request = CompareRequest(
        out=out,
        recordings=tuple(replace(entry, source=source) for source in sources),
        methods=() if names is None else parse_methods(names),
        config_file=config_file,
        settings=(*settings, *reader_settings(name=reader, topic=topic, sequence=sequence)),
        limits=Limits(memory_limit_mb, timeout_s),
        where=where,
        overwrite=overwrite,
        reuse=reuse,
        command=command_line("lidarslam", *sys.argv[1:]),
    )
    with ended_like_interrupted():  # or the methods would outlive a request to end
        if benchmark is not None:
            described = load_benchmark(benchmark)
            request = fill_request(request, described, data)
            require_data(request, described, data)
        require_methods(gates, [method.name for method in request.methods])
        if benchmark is not None:
            make_recordings(request, show_count)
        outcome = compare(request, Narrator(show_count, tell))
    say(format_comparison(outcome.comparison, out))
    if outcome.is_empty:
        tell("no method came to a result; the table says why")
    passed = not gates or _passes(gates, outcome, out, say)
    return Ending(not outcome.interrupted and not outcome.is_empty, passed)


def _passes(gates: Sequence[Gate], outcome: CompareOutcome, out: Path, say: Say) -> bool:
    """Whether the gates hold, which is printed."""
    sequences = outcome.comparison.sequences
    runs = [result.run for sequence in sequences for result in sequence.methods if result.run]
    judged = judge_comparison(gates, sequences, {run: read_summary(out / run) for run in runs})
    say(f"\n{format_gates(judged)}")
    return all(gate.passed for gate in judged)
