"""Means over recordings, as papers print them: a row a method, a column for each group and quantity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lidarslam.evaluation.comparison.comparison import WHOLE, MethodResult, SequenceComparison
from lidarslam.evaluation.comparison.quantities import Quantity, times_note
from lidarslam.evaluation.comparison.table import Table, TableCell, TableColumn, TableRow


@dataclass(frozen=True)
class TablePlan:
    """Content of a table of means."""

    # title, note: as in `Table`
    title: str
    groups: Mapping[str, Sequence[str]]  # heading -> the recordings averaged under it
    quantities: Sequence[Quantity]  # the columns under each heading
    published: Sequence[TableRow] = ()  # others' rows, a cell for each column
    note: str = ""


def mean_table(plan: TablePlan, sequences: Sequence[SequenceComparison]) -> Table:
    """The unweighted means over the recordings of each group that a method finished and has a value of."""
    columns = [
        TableColumn(heading, q.label, q.unit, q.digits, q.lower_is_better, tuple(group))
        for heading, group in plan.groups.items()
        for q in plan.quantities
    ]
    quantities = [quantity for _ in plan.groups for quantity in plan.quantities]
    results = {(sequence.sequence, result.name): result for sequence in sequences for result in sequence.methods}
    methods = dict.fromkeys(name for _, name in results)
    rows = []
    for method in methods:
        found = [[results.get((name, method)) for name in column.sequences] for column in columns]
        rows.append(TableRow(method, [_mean(*of) for of in zip(found, quantities, strict=True)]))
    has_times = any(quantity.is_time for quantity in plan.quantities)
    note = " ".join(filter(None, [plan.note, times_note(results.values()) if has_times else ""]))
    return Table(plan.title, columns, [*rows, *plan.published], note)


def _mean(results: Sequence[MethodResult | None], quantity: Quantity) -> TableCell:
    """A mean over fewer recordings than the column names has a note. Only comparable means are ranked."""
    finished = [result for result in results if result is not None and result.status in WHOLE]
    values = [value for result in finished if (value := quantity.of(result)) is not None]
    if not values:
        return TableCell(None, 0)
    complete = len(values) == len(results)
    comparable = complete and all(quantity.is_comparable(result) for result in finished)
    note = "" if complete else f"over {len(values)} of {len(results)}"
    return TableCell(sum(values) / len(values), len(values), note, comparable)
