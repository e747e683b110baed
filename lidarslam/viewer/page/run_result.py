"""A finished run as a result that reports and comparisons show."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.comparison.comparison import MethodResult, ScanSeries
from lidarslam.storage import directory as files
from lidarslam.storage.finished_run import read_statuses, read_summary, read_trajectory


def with_run(result: MethodResult, run: Path) -> MethodResult:
    """The result with what a run directory holds.

    Raises:
        InputError: a file is damaged, or lacks a quantity.
    """
    trajectory, summary = read_trajectory(run), read_summary(run)
    statuses = read_statuses(run, len(trajectory))
    try:
        latency = summary.get("latency_ms", {})  # absent from runs of earlier versions
        ms = {stage: values["median"] for stage, values in summary["ms_per_scan"].items()}
        return replace(
            result,
            scans=len(trajectory),
            trajectory=trajectory,
            lost=np.array([status == "lost" for status in statuses], dtype=np.bool_),
            lost_reasons=tuple(stretch["reason"] for stretch in summary["lost"]),
            map_entropy=summary["map_entropy"],
            elapsed_ms_per_scan=summary.get("elapsed_ms_per_scan"),
            latency_ms_median=latency.get("median"),
            latency_ms_p99=latency.get("p99"),
            ms_per_scan_median=ms.pop("total"),
            ms_per_scan_p95=summary["ms_per_scan"]["total"]["p95"],
            ms_per_scan_p99=summary["ms_per_scan"]["total"]["p99"],
            stage_ms=ms,
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{run / files.SUMMARY}: not a run's summary ({error!r}); make the run again") from error


def read_series(run: Path) -> ScanSeries | None:
    """The registration of each scan; None where no table has been kept.

    Raises:
        InputError: the table is damaged.
    """
    file = run / files.SCANS_CSV
    if not file.is_file():
        return None
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = list(csv.DictReader(lines))
        stamps = _column(rows, "stamp")
        return ScanSeries(
            times_s=stamps - stamps[:1],
            statuses=read_statuses(run, len(rows)),
            residual_m=_column(rows, "residual_m"),
            inlier_ratio=_column(rows, "inlier_ratio"),
            points_used=_column(rows, "points_used"),
        )
    except (KeyError, ValueError, csv.Error) as error:
        raise InputError(f"{file}: not a run's table ({error!r}); make the run again") from error


def _column(rows: list[dict[str, str]], name: str) -> FloatArray:
    """Numbers (N,), NaN where there is none."""
    return np.array([float(row[name] or "nan") for row in rows], dtype=np.float64)
