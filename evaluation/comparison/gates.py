"""Quality gates: bounds on the figures of metrics.json and summary.json, for continuous integration."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from lidarslam.core.errors import ConfigError
from lidarslam.evaluation.comparison.comparison import SequenceComparison, look_up
from lidarslam.evaluation.trajectory.metrics import KITTI_LENGTHS_M, SHORT_LENGTHS_M, metrics_json

Figures = Mapping[str, object]
"""metrics.json and summary.json under the keys `metrics` and `summary`."""

Kind = Literal["max", "min"]

FIGURES: dict[str, str] = {
    "ate": "metrics/trajectory/ate_rmse_m",
    "ate_rotation": "metrics/trajectory/ate_rotation_rmse_deg",
    "rpe": "metrics/trajectory/rpe_translation_rmse_m",
    "rpe_rotation": "metrics/trajectory/rpe_rotation_rmse_deg",
    "end_error": "metrics/trajectory/end_error_m",
    "matched": "metrics/association/matched",
    "kitti": "metrics/kitti/translation_percent",
    "kitti_rotation": "metrics/kitti/rotation_deg_per_100m",
    "accuracy": "metrics/map/accuracy_mean_m",
    "completeness": "metrics/map/completeness_mean_m",
    "chamfer": "metrics/map/chamfer_m",
    **{f"f_score_{m}": f"metrics/map/f_score_percent/{m}" for m in ("0.1", "0.2", "0.5")},
    "coverage": "metrics/map/coverage_percent/1.0",
    "deviation": "metrics/map/deviation_percent/1.0",
    "entropy": "metrics/map_entropy/mean_map_entropy",
    "lost": "summary/lost_scans",
    "degraded": "summary/degraded_scans",
    "loops": "summary/loop_closures",
    "elapsed_ms_per_scan": "summary/elapsed_ms_per_scan",
    "latency_ms": "summary/latency_ms/median",
    "latency_ms_p99": "summary/latency_ms/p99",
    "ms_per_scan": "summary/ms_per_scan/total/median",
    "ms_per_scan_p95": "summary/ms_per_scan/total/p95",
    "ms_per_scan_p99": "summary/ms_per_scan/total/p99",
    "realtime_factor": "summary/realtime_factor",
    "memory_mb": "summary/peak_rss_mb",
}
"""Short name -> keys from the root of the figures, separated by slashes."""

_DRIFTS = {
    **{f"kitti/by_length/{m}": "rotation_deg_per_100m" for m in KITTI_LENGTHS_M},
    **{f"segments/{m}": "rotation_deg_per_10m" for m in SHORT_LENGTHS_M},
}
# The dotted paths of metrics.json.
PATHS: dict[str, str] = {
    keys.partition("/")[2].replace("/", "."): keys
    for keys in (
        *(keys for keys in FIGURES.values() if keys.startswith("metrics/")),
        *(f"metrics/{part}/{key}" for part, rotation in _DRIFTS.items() for key in ("translation_percent", rotation)),
        "metrics/trajectory/length_m",
    )
}
_PLUGIN = re.compile(r"plugins\.[^.]+\.[^.]+")  # of another package's metric


@dataclass(frozen=True)
class Gate:
    """A bound of one figure."""

    kind: Kind
    figure: str  # a short name, or a dotted path of metrics.json
    bound: float
    method: str | None = None  # of a comparison; None: every method

    def of(self, figures: Figures) -> float | None:
        """The figure; None where it could not be computed."""
        path = FIGURES.get(self.figure) or PATHS.get(self.figure) or f"metrics/{self.figure.replace('.', '/')}"
        return look_up(figures, path)


@dataclass(frozen=True)
class JudgedGate:
    """A gate and the figure it was applied to."""

    gate: Gate
    value: float | None  # None where it could not be computed, which fails
    where: str = ""  # recording and method

    @property
    def passed(self) -> bool:
        """Whether the figure is within the bound, the bound included."""
        if self.value is None:
            return False
        return self.value <= self.gate.bound if self.gate.kind == "max" else self.value >= self.gate.bound


def parse_gate(kind: Kind, text: str, with_method: bool = False) -> Gate:
    """The gate `NAME=VALUE`, of a comparison `METHOD:NAME=VALUE` too."""
    method_and_name, _, value = text.rpartition("=")
    method, colon, name = method_and_name.strip().rpartition(":")
    form = f"--{kind} {text}: expected {'[METHOD:]' if with_method else ''}NAME=VALUE, such as ate=0.1"
    if not name or (colon and not (with_method and method)):
        raise ConfigError(form)
    try:
        bound = float(value)
    except ValueError:
        raise ConfigError(form) from None
    if not math.isfinite(bound):
        raise ConfigError(form)
    if name not in FIGURES and name not in PATHS and not _PLUGIN.fullmatch(name):
        raise ConfigError(
            f"--{kind} {text}: no figure is called {name!r}; there are: {', '.join(FIGURES)}, and paths of"
            " metrics.json such as segments.25.translation_percent, or plugins.NAME.KEY of another package's metric"
        )
    return Gate(kind, name, bound, method or None)


def judge(gates: Iterable[Gate], figures: Figures) -> list[JudgedGate]:
    """The gates, applied to one run."""
    return [JudgedGate(gate, gate.of(figures)) for gate in gates]


def require_methods(gates: Iterable[Gate], methods: Sequence[str]) -> None:
    """Refuse gates of methods that are not compared."""
    for gate in gates:
        if gate.method is not None and gate.method not in methods:
            raise ConfigError(f"--{gate.kind}: no method is called {gate.method!r}; there are: {', '.join(methods)}")


def judge_comparison(
    gates: Sequence[Gate], sequences: Iterable[SequenceComparison], summaries: Mapping[str, Mapping[str, object]]
) -> list[JudgedGate]:
    """The gates, applied to each method of each recording.

    The method that is the reference has no errors, which fails only gates that name it. The summaries are the contents
    of summary.json by run directory as `MethodResult.run` names it.
    """
    judged = []
    for sequence in sequences:
        for result in sequence.methods:
            metrics = metrics_json(result.metrics, result.map_metrics)
            metrics["map_entropy"] = {"mean_map_entropy": result.map_entropy}
            summary = {**summaries.get(result.run, {}), "lost_scans": result.lost_scans}
            figures = {"metrics": metrics, "summary": summary}
            for gate in gates:
                value = gate.of(figures)
                is_own_reference = gate.method is None and value is None and result.name == sequence.reference_name
                if gate.method in (None, result.name) and not is_own_reference:
                    judged.append(JudgedGate(gate, value, f"{sequence.sequence} {result.name}"))
    return judged


def format_gates(judged: Sequence[JudgedGate]) -> str:
    """A line for each gate, and the number that failed."""
    rows = []
    for each in judged:
        sign = "<=" if each.gate.kind == "max" else ">="
        value = "could not be computed" if each.value is None else f"{each.value:.6g}"
        bound = f"{sign} {each.gate.bound:.6g}"
        rows.append((each.where, each.gate.figure, value, bound, "pass" if each.passed else "FAIL"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True) if width) for row in rows)
    failed = sum(not each.passed for each in judged)
    last = f"{failed} of {len(judged)} failed" if failed else f"all {len(judged)} passed"
    return "\n".join(["GATES", *(line.rstrip() for line in lines), last])
