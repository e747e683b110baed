"""The quantities that tables are made of, by name, and tables of their means over recordings, as papers print them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from pydantic import Field, model_validator

from lidarslam.core.settings import Settings
from lidarslam.evaluation.comparison.comparison import (
    WHOLE,
    MethodResult,
    SequenceComparison,
    Table,
    TableCell,
    TableColumn,
    TableRow,
    look_up,
)
from lidarslam.evaluation.trajectory.drift import SHORT_LENGTHS_M

_TRAJECTORY, _KITTI, _SEGMENTS, _MAP = (f"metrics/{part}/" for part in ("trajectory", "kitti", "segments", "map"))


@dataclass(frozen=True)
class Quantity:
    """One number of a method on a recording."""

    path: str  # of the keys in `MethodResult.to_json()`, separated by slashes
    label: str  # short, for the head of a column
    unit: str  # empty for counts
    digits: int  # after the decimal point
    lower_is_better: bool | None = True  # None for a quantity that is not ranked
    # path of the value that the number is given in percent of; None: it is given as it is
    percent_of: str | None = None
    is_time: bool = False  # of a scan, as far as `MethodResult.times_cover` says

    def of(self, result: MethodResult) -> float | None:
        """The number; None where there is none."""
        entry = {**result.to_json(), "map_entropy": result.map_entropy}
        value = look_up(entry, self.path)
        if self.percent_of is None or value is None:
            return value
        whole = look_up(entry, self.percent_of)
        return 100.0 * value / whole if whole else None

    def is_comparable(self, result: MethodResult) -> bool:
        """Whether the number is of the whole recording, and a time of all stages of a scan."""
        return result.status in WHOLE and not (self.is_time and result.times_cover == "registration")

    def column(self, heading: str = "", sequences: Sequence[str] = ()) -> TableColumn:
        """Its column of a table."""
        return TableColumn(heading, self.label, self.unit, self.digits, self.lower_is_better, sequences)

    def cell(self, result: MethodResult) -> TableCell:
        """The number in a table."""
        return TableCell(self.of(result), ranked=self.is_comparable(result))


def times_note(results: Iterable[MethodResult]) -> str:
    """A sentence on the methods whose times are of the registration alone; empty without any."""
    names = dict.fromkeys(result.name for result in results if result.times_cover == "registration")
    if not names:
        return ""
    return f"Times of {', '.join(names)}: registration alone, without reading and map; not ranked with the others."


QUANTITIES: dict[str, Quantity] = {
    "ate_rmse_m": Quantity(_TRAJECTORY + "ate_rmse_m", "ATE", "m", 3),
    "ate_percent_of_path": Quantity(
        _TRAJECTORY + "ate_rmse_m", "ATE", "% of path", 2, percent_of=_TRAJECTORY + "length_m"
    ),
    "ate_rotation_rmse_deg": Quantity(_TRAJECTORY + "ate_rotation_rmse_deg", "rotation", "deg", 2),
    "rpe_translation_rmse_m": Quantity(_TRAJECTORY + "rpe_translation_rmse_m", "RPE", "m", 3),
    "rpe_rotation_rmse_deg": Quantity(_TRAJECTORY + "rpe_rotation_rmse_deg", "RPE rotation", "deg", 3),
    "end_error_m": Quantity(_TRAJECTORY + "end_error_m", "end error", "m", 2),
    "kitti_translation_percent": Quantity(_KITTI + "translation_percent", "t_rel", "%", 2),
    "kitti_rotation_deg_per_100m": Quantity(_KITTI + "rotation_deg_per_100m", "r_rel", "deg/100 m", 2),
    **{
        f"segment_{m}_{key}": Quantity(f"{_SEGMENTS}{m}/{key}", f"{m} m {label}", unit, 3)
        for m in SHORT_LENGTHS_M
        for key, label, unit in (
            ("translation_percent", "t_rel", "%"),
            ("rotation_deg_per_10m", "r_rel", "deg/10 m"),
        )
    },
    "map_accuracy_mean_m": Quantity(_MAP + "accuracy_mean_m", "map accuracy", "m", 3),
    "map_completeness_mean_m": Quantity(_MAP + "completeness_mean_m", "map completeness", "m", 3),
    "map_chamfer_m": Quantity(_MAP + "chamfer_m", "map chamfer", "m", 3),
    **{
        f"map_f_score_percent_{m}": Quantity(f"{_MAP}f_score_percent/{m}", f"map F-score {m} m", "%", 1, False)
        for m in ("0.1", "0.2", "0.5")
    },
    "map_coverage_percent_1.0": Quantity(_MAP + "coverage_percent/1.0", "map coverage 1.0 m", "%", 1, False),
    "map_deviation_percent_1.0": Quantity(_MAP + "deviation_percent/1.0", "map deviation 1.0 m", "%", 1),
    "map_entropy": Quantity("map_entropy", "map entropy", "", 2),
    "elapsed_ms_per_scan": Quantity("elapsed_ms_per_scan", "elapsed", "ms/scan", 1, is_time=True),
    "latency_ms_median": Quantity("latency_ms_median", "latency (median)", "ms", 1, is_time=True),
    "latency_ms_p99": Quantity("latency_ms_p99", "latency (99 %)", "ms", 1, is_time=True),
    "ms_per_scan_median": Quantity("ms_per_scan_median", "between scans (median)", "ms/scan", 1, is_time=True),
    "ms_per_scan_p95": Quantity("ms_per_scan_p95", "between scans (95 %)", "ms/scan", 1, is_time=True),
    "ms_per_scan_p99": Quantity("ms_per_scan_p99", "between scans (99 %)", "ms/scan", 1, is_time=True),
    "odometry_ms_median": Quantity("stage_ms/odometry", "odometry", "ms/scan", 1),
    "peak_rss_mb": Quantity("peak_rss_mb", "memory", "MB", 0),
    "wall_s": Quantity("wall_s", "wall time", "s", 1),
    "lost_scans": Quantity("lost_scans", "lost scans", "", 0),
}
"""Name -> quantity, in the order of metrics.json."""


class Published(Settings):
    """A row of a published table; a value for each column, null where none was published."""

    method: str
    values: tuple[float | str | None, ...]
    source: str


class TablePlan(Settings):
    """Means over groups of recordings; a column for each group and quantity, the quantities side by side."""

    title: str
    groups: Mapping[str, tuple[str, ...]] = Field(description="heading -> names of recordings")
    quantities: tuple[str, ...]
    published: tuple[Published, ...] = ()
    note: str = ""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        columns = len(self.groups) * len(self.quantities)
        for row in self.published:
            if len(row.values) != columns:
                raise ValueError(
                    f"table {self.title!r}, row {row.method!r}: expected {columns} values, one for each group and"
                    f" quantity, got {len(row.values)}"
                )
        unknown = next((name for name in self.quantities if name not in QUANTITIES), None)
        if unknown is not None:
            names = ", ".join(QUANTITIES)
            raise ValueError(f"table {self.title!r}: no quantity is called {unknown!r}; there are: {names}")
        return self


def mean_table(plan: TablePlan, sequences: Sequence[SequenceComparison]) -> Table:
    """The unweighted means over the recordings of each group that a method finished and has a value of."""
    chosen = [QUANTITIES[name] for name in plan.quantities]
    columns = [q.column(heading, group) for heading, group in plan.groups.items() for q in chosen]
    quantities = chosen * len(plan.groups)
    results = {(sequence.sequence, result.name): result for sequence in sequences for result in sequence.methods}
    methods = dict.fromkeys(name for _, name in results)
    rows = []
    for method in methods:
        found = [[results.get((name, method)) for name in column.sequences] for column in columns]
        rows.append(TableRow(method, [_mean(*of) for of in zip(found, quantities, strict=True)]))
    for row in plan.published:
        cells = [TableCell(v, len(of.sequences)) for v, of in zip(row.values, columns, strict=True)]
        rows.append(TableRow(row.method, cells, row.source))
    has_times = any(quantity.is_time for quantity in chosen)
    note = " ".join(filter(None, [plan.note, times_note(results.values()) if has_times else ""]))
    return Table(plan.title, columns, rows, note)


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
