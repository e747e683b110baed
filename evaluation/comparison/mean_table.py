"""Means over recordings, as papers print them: a line a method, a column for each group and quantity."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.comparison.quantities import Quantity
from evaluation.comparison.summary_table import SummaryTable, TableCell, TableColumn, TableRow

# A run that ended early is no measurement of the whole recording.
_WHOLE = ("ok", "lost")


@dataclass(frozen=True)
class TablePlan:
    """What a table is to show.

    Attributes:
        title, note: as in `SummaryTable`.
        groups: heading -> the recordings averaged under it.
        quantities: the columns under each heading.
        published: others' rows, a cell for each column.
    """

    title: str
    groups: Mapping[str, Sequence[str]]
    quantities: Sequence[Quantity]
    published: Sequence[TableRow] = ()
    note: str = ""


def mean_table(plan: TablePlan, sequences: Sequence[SequenceComparison]) -> SummaryTable:
    """Fill the table: recordings count alike, those without a value or on which the run ended early not at all."""
    columns = [(group, quantity) for group in plan.groups.values() for quantity in plan.quantities]
    results = {(sequence.sequence, result.name): result for sequence in sequences for result in sequence.methods}
    methods = dict.fromkeys(result.name for sequence in sequences for result in sequence.methods)
    rows = [
        TableRow(method, [_mean(_chosen(results, group, method), quantity) for group, quantity in columns])
        for method in methods
    ]
    return SummaryTable(plan.title, list(_heads(plan)), [*rows, *plan.published], plan.note)


def _heads(plan: TablePlan) -> Iterator[TableColumn]:
    for heading, sequences in plan.groups.items():
        for quantity in plan.quantities:
            yield TableColumn(
                heading, quantity.label, quantity.unit, quantity.digits, quantity.lower_is_better, tuple(sequences)
            )


def _chosen(
    results: Mapping[tuple[str, str], MethodResult], group: Sequence[str], method: str
) -> Iterator[MethodResult]:
    for sequence in group:
        result = results.get((sequence, method))
        if result is not None and result.status in _WHOLE:
            yield result


def _mean(results: Iterator[MethodResult], quantity: Quantity) -> TableCell:
    values = [value for result in results if (value := quantity.of(result)) is not None]
    return TableCell(sum(values) / len(values) if values else None, len(values))
