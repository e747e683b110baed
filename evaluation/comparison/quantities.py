"""The quantities that tables are made of, by name, read off a method's entry in comparison.json."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from evaluation.comparison.comparison import MethodResult
from evaluation.trajectory.drift import SHORT_LENGTHS_M
from lidarslam.core.errors import ConfigError


@dataclass(frozen=True)
class Quantity:
    """One number of a method on a recording.

    Attributes:
        keys: where it stands in `MethodResult.to_json()`.
        label: short, for the head of a column.
        unit: empty for counts.
        digits: after the decimal point.
        lower_is_better: None where neither end is the good one.
        percent_of: where that stands of which the number is given in percent; None: it is given as it is.
    """

    keys: tuple[str, ...]
    label: str
    unit: str
    digits: int
    lower_is_better: bool | None = True
    percent_of: tuple[str, ...] | None = None

    def of(self, result: MethodResult) -> float | None:
        """The number; None where there is none."""
        entry = result.to_json()
        value = _look_up(entry, self.keys)
        if self.percent_of is None or value is None:
            return value
        whole = _look_up(entry, self.percent_of)
        return 100.0 * value / whole if whole else None


def _look_up(entry: object, keys: tuple[str, ...]) -> float | None:
    for key in keys:
        entry = entry.get(key) if isinstance(entry, Mapping) else None
    return float(entry) if isinstance(entry, int | float) else None


def find_quantity(name: str) -> Quantity:
    """The quantity of that name.

    Raises:
        ConfigError: there is none.
    """
    if name not in QUANTITIES:
        raise ConfigError(f"no quantity is called {name!r}; there are: {', '.join(QUANTITIES)}")
    return QUANTITIES[name]


def _trajectory(name: str, label: str, unit: str, digits: int) -> tuple[str, Quantity]:
    return name, Quantity(("metrics", "trajectory", name), label, unit, digits)


def _segments(length_m: int) -> Iterable[tuple[str, Quantity]]:
    keys = ("metrics", "segments", str(length_m))
    translation = Quantity((*keys, "translation_percent"), f"{length_m} m t_rel", "%", 3)
    rotation = Quantity((*keys, "rotation_deg_per_10m"), f"{length_m} m r_rel", "deg/10 m", 3)
    yield f"segment_{length_m}_translation_percent", translation
    yield f"segment_{length_m}_rotation_deg_per_10m", rotation


def _map(name: str, label: str, unit: str, tolerance_m: str = "", lower_is_better: bool = True) -> tuple[str, Quantity]:
    """A quantity of the map; a tolerance that it depends on is part of its name."""
    keys = ("metrics", "map", name, *([tolerance_m] if tolerance_m else []))
    digits = 1 if unit == "%" else 3
    label = f"{label} {tolerance_m} m" if tolerance_m else label
    return "_".join(["map", *keys[2:]]), Quantity(keys, label, unit, digits, lower_is_better)


QUANTITIES: dict[str, Quantity] = dict(
    [
        _trajectory("ate_rmse_m", "ATE", "m", 3),
        (
            "ate_percent_of_path",
            Quantity(
                ("metrics", "trajectory", "ate_rmse_m"),
                "ATE",
                "% of path",
                2,
                percent_of=("metrics", "trajectory", "length_m"),
            ),
        ),
        _trajectory("ate_rotation_rmse_deg", "rotation", "deg", 2),
        _trajectory("rpe_translation_rmse_m", "RPE", "m", 3),
        _trajectory("rpe_rotation_rmse_deg", "RPE rotation", "deg", 3),
        _trajectory("end_error_m", "end error", "m", 2),
        ("kitti_translation_percent", Quantity(("metrics", "kitti", "translation_percent"), "t_rel", "%", 2)),
        (
            "kitti_rotation_deg_per_100m",
            Quantity(("metrics", "kitti", "rotation_deg_per_100m"), "r_rel", "deg/100 m", 2),
        ),
        *(pair for length_m in SHORT_LENGTHS_M for pair in _segments(length_m)),
        _map("accuracy_mean_m", "map accuracy", "m"),
        _map("completeness_mean_m", "map completeness", "m"),
        _map("chamfer_m", "map chamfer", "m"),
        *(_map("f_score_percent", "map F-score", "%", tolerance_m, False) for tolerance_m in ("0.1", "0.2", "0.5")),
        _map("coverage_percent", "map coverage", "%", "1.0", False),
        _map("deviation_percent", "map deviation", "%", "1.0"),
        ("ms_per_scan_median", Quantity(("ms_per_scan_median",), "time", "ms/scan", 1)),
        ("ms_per_scan_p95", Quantity(("ms_per_scan_p95",), "time (95 %)", "ms/scan", 1)),
        ("odometry_ms_median", Quantity(("stage_ms", "odometry"), "odometry", "ms/scan", 1)),
        ("peak_rss_mb", Quantity(("peak_rss_mb",), "memory", "MB", 0)),
        ("wall_s", Quantity(("wall_s",), "wall time", "s", 1)),
        ("lost_scans", Quantity(("lost_scans",), "lost scans", "", 0)),
    ]
)
"""Name -> quantity, in the order of metrics.json."""
