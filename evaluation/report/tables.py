"""The tables of one recording."""

from collections.abc import Callable, Mapping, Sequence

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.comparison.quantities import QUANTITIES, Quantity
from evaluation.comparison.table import Cell, Column, Row, Table, with_best, without_empty
from evaluation.trajectory.drift import KITTI_LENGTHS_M, SHORT_LENGTHS_M, Drift
from evaluation.trajectory.lost_stretches import LostStretch, lost_stretches

_SUMMARY = (
    "ate_rmse_m",
    "ate_rotation_rmse_deg",
    "rpe_translation_rmse_m",
    "rpe_rotation_rmse_deg",
    "end_error_m",
    "kitti_translation_percent",
    "kitti_rotation_deg_per_100m",
    "map_f_score_percent_0.2",
    "ms_per_scan_median",
    "peak_rss_mb",
)
_TIME = ("ms_per_scan_median", "ms_per_scan_p95", "peak_rss_mb", "wall_s")
_WHOLE = ("ok", "lost")
_SYMBOLS = {"ok": "✓", "lost": "△", "stopped": "◐"}
_MOST_STRETCHES = 40
_METHOD = Column("Method", numeric=False)

_Parts = Callable[[MethodResult], Mapping[int, Drift | None] | None]


def summary_table(sequence: SequenceComparison) -> Table:
    """How each method ended, and its figures beside one another."""
    quantities = [QUANTITIES[name] for name in _SUMMARY]
    columns = [_METHOD, Column("Status", numeric=False), *map(quantity_column, quantities)]
    rows = [
        Row([Cell(m.name), Cell(status_text(m), m.message), *(_measured(m, q) for q in quantities)], m.name)
        for m in sequence.methods
    ]
    note = "" if all(m.status in _WHOLE or m.metrics is None for m in sequence.methods) else (
        "What a method that ended early has is of the part it did, and is not ranked."
    )  # fmt: skip
    return with_best(without_empty(Table(f"{sequence.sequence}: all methods", columns, rows, note)))


def drift_tables(sequence: SequenceComparison) -> list[Table]:
    """Drift over short segments, over KITTI's, and by speed; those without any figure are left out."""
    speeds = sorted(
        {
            mps
            for method in sequence.methods
            if method.metrics is not None and method.metrics.kitti is not None
            for mps, drift in method.metrics.kitti.by_speed.items()
            if drift is not None
        }
    )
    name = sequence.sequence
    kinds: list[tuple[str, _Parts, Sequence[int], str, int, bool]] = [
        (f"{name}: drift over segments of 5 to 100 m", _segments, SHORT_LENGTHS_M, "m", 10, False),
        (f"{name}: drift over segments of 100 to 800 m (KITTI)", _by_length, KITTI_LENGTHS_M, "m", 100, False),
        (f"{name}: drift over segments of 100 to 800 m by speed", _by_speed, speeds, "m/s", 100, True),
    ]
    tables = [_drift_table(sequence, *kind) for kind in kinds]
    return [table for table in tables if table is not None]


def map_table(sequence: SequenceComparison) -> Table | None:
    """Errors of the maps; None when no map was compared."""
    if all(method.map_metrics is None for method in sequence.methods):
        return None
    quantities = [quantity for name, quantity in QUANTITIES.items() if name.startswith("map_")]
    columns = [_METHOD, *(quantity_column(quantity, prefix="map ") for quantity in quantities)]
    rows = [Row([Cell(m.name), *(_measured(m, q) for q in quantities)], m.name) for m in sequence.methods]
    note = (
        "Accuracy: map to reference; completeness: reference to map; chamfer: the mean of both. Coverage and deviation:"
        " the reference's points within, and the map's points beyond, the tolerance."
    )
    return with_best(without_empty(Table(f"{sequence.sequence}: map against the reference map", columns, rows, note)))


def time_table(sequence: SequenceComparison) -> Table | None:
    """Time and memory; None when nothing was measured."""
    stages = list(dict.fromkeys(stage for method in sequence.methods for stage in method.stage_ms))
    quantities = [QUANTITIES[name] for name in _TIME]
    staged = [Column(f"{stage} [ms]", 1, True, group="median of a stage") for stage in stages]
    columns = [_METHOD, *map(quantity_column, quantities), *staged]
    rows = [
        Row([Cell(m.name), *(_measured(m, q) for q in quantities), *(Cell(m.stage_ms.get(s)) for s in stages)], m.name)
        for m in sequence.methods
    ]
    table = without_empty(Table(f"{sequence.sequence}: time and memory", columns, rows))
    return with_best(table) if len(table.columns) > 1 else None


def lost_table(sequence: SequenceComparison) -> Table | None:
    """Where tracking was lost or a method ended, with the reason; None when every scan was tracked."""
    rows = [row for method in sequence.methods for row in _lost_rows(method)]
    if not rows:
        return None
    columns = [
        _METHOD,
        Column("Status", numeric=False),
        Column("Scans"),
        Column("First"),
        Column("Last"),
        Column("From [s]", 1),
        Column("To [s]", 1),
        Column("Reason", numeric=False),
    ]
    note = "First and last: numbers of scans, from 0; times since the method's first scan."
    return Table(f"{sequence.sequence}: where tracking was lost", columns, rows, note)


def quantity_column(quantity: Quantity, prefix: str = "") -> Column:
    """The column of a quantity; a prefix of its label that the table's title says already is dropped."""
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    return Column(f"{quantity.label.removeprefix(prefix)}{unit}", quantity.digits, quantity.lower_is_better)


def status_text(method: MethodResult) -> str:
    """How a method ended, with a sign, and how much was lost."""
    lost = f" {method.lost_scans} of {method.scans} scans" if method.status == "lost" and method.lost_scans else ""
    return f"{_SYMBOLS.get(method.status, '✕')} {method.status}{lost}"


def _measured(method: MethodResult, quantity: Quantity) -> Cell:
    return Cell(quantity.of(method), may_win=method.status in _WHOLE)


def _drift_table(
    sequence: SequenceComparison, title: str, parts: _Parts, places: Sequence[int], unit: str, per_m: int, folded: bool
) -> Table | None:
    by_method = [(method, parts(method)) for method in sequence.methods]
    reached = [place for place in places if any(drifts and drifts.get(place) for _, drifts in by_method)]
    if not reached:
        return None
    groups = ("translation [%]", f"rotation [deg/{per_m} m]")
    columns = [
        _METHOD,
        *(Column(f"{place} {unit}", _digits(per_m), True, group) for group in groups for place in reached),
    ]
    rows = []
    for method, drifts in by_method:
        found = [(drifts or {}).get(place) for place in reached]
        values = [None if drift is None else drift.translation_percent for drift in found]
        values += [None if drift is None else drift.rotation_deg_per_m * per_m for drift in found]
        rows.append(Row([Cell(method.name), *(Cell(v, may_win=method.status in _WHOLE) for v in values)], method.name))
    return with_best(Table(title, columns, rows, folded=folded))


def _digits(per_m: int) -> int:
    """As papers print them: two decimals over KITTI's lengths, three over short ones."""
    return 2 if per_m == 100 else 3


def _segments(method: MethodResult) -> Mapping[int, Drift | None] | None:
    return None if method.metrics is None else method.metrics.segments


def _by_length(method: MethodResult) -> Mapping[int, Drift | None] | None:
    kitti = None if method.metrics is None else method.metrics.kitti
    return None if kitti is None else kitti.by_length


def _by_speed(method: MethodResult) -> Mapping[int, Drift | None] | None:
    kitti = None if method.metrics is None else method.metrics.kitti
    return None if kitti is None else kitti.by_speed


def _lost_rows(method: MethodResult) -> list[Row]:
    stretches = lost_stretches(method)
    rows = [_lost_row(method, stretch) for stretch in stretches[:_MOST_STRETCHES]]
    if len(stretches) > _MOST_STRETCHES:
        more = Cell(f"and {len(stretches) - _MOST_STRETCHES} more stretches")
        rows.append(Row([Cell(method.name), Cell(method.status), *[Cell(None)] * 5, more], method.name))
    if not stretches and method.status != "ok":
        rows.append(Row([Cell(method.name), Cell(method.status), *[Cell(None)] * 5, Cell(method.message)], method.name))
    return rows


def _lost_row(method: MethodResult, stretch: LostStretch) -> Row:
    begin_s = 0.0 if method.trajectory is None else float(method.trajectory.stamps[0])
    numbers = [stretch.scans, stretch.first, stretch.last, stretch.begin_s - begin_s, stretch.end_s - begin_s]
    return Row(
        [Cell(method.name), Cell(method.status), *(Cell(number) for number in numbers), Cell(stretch.reason)],
        method.name,
    )
