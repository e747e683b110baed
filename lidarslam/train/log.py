"""The log of a training: tables of losses and validations, curves for TensorBoard, lines on the console."""

import csv
import math
from collections.abc import Mapping
from datetime import timedelta
from io import SEEK_END, TextIOWrapper
from pathlib import Path

from torch.utils.tensorboard.writer import SummaryWriter

from lidarslam.core.errors import InputError
from lidarslam.core.files import make_own_folder, open_own, replacing
from lidarslam.core.text import as_typed, count
from lidarslam.odometry.training.training import Validation
from lidarslam.train import directory as files


class TrainingLog:
    """Appends to the tables; lines after the step that the training resumes from are dropped, all of a new one."""

    def __init__(self, out: Path, step: int | None) -> None:
        self._out = out
        for name in (files.LOSSES, files.VALIDATION):
            _cut(out / name, -1 if step is None else step)
        make_own_folder(out / files.CURVES)
        self._curves = SummaryWriter(str(out / files.CURVES), purge_step=step + 1 if step else None)

    def losses(self, step: int, row: Mapping[str, float]) -> None:
        """Means since the last line."""
        self._write(files.LOSSES, "training", step, row)

    def validation(self, step: int, result: Validation) -> None:
        """Errors on held-out recordings."""
        values = vars(result).copy()
        for k, percent in enumerate(values.pop("covered_percent"), start=1):
            values[f"covered_{k}_sigma_percent"] = percent
        self._write(files.VALIDATION, "validation", step, values)
        self._curves.flush()

    def close(self) -> None:
        """Write the rest."""
        self._curves.close()

    def _write(self, table: str, curves: str, step: int, row: Mapping[str, float]) -> None:
        _append(self._out / table, {"step": step, **row})
        for name, value in row.items():
            self._curves.add_scalar(f"{curves}/{name}", value, step)


def _append(path: Path, row: Mapping[str, object]) -> None:
    with TextIOWrapper(open_own(path), encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if file.seek(0, SEEK_END) == 0:
            writer.writeheader()
        writer.writerow(row)


def _cut(path: Path, step: int) -> None:
    """Keep the lines up to a step."""
    if not path.exists():
        return
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: is damaged ({error!r}); remove it, or begin again with --overwrite") from error
    if not rows:
        path.unlink()
        return
    with replacing(path) as partial:
        for row in rows:
            _append(partial, row)


def format_step(step: int, steps: int, losses: Mapping[str, float], pairs_per_s: float, left_s: float) -> str:
    """Means of the losses since the last line; parts that are switched off are left out."""
    parts = ", ".join(
        f"{name.replace('_', '-')} {value:.4g}" for name, value in losses.items() if name != "total" and value
    )
    return (
        f"step {step:,}/{steps:,}  loss {losses['total']:.4g} ({parts})"
        f"  {pairs_per_s:.1f} pairs/s  {timedelta(seconds=math.ceil(left_s))} left"
    )


def format_validation(step: int, result: Validation, improves: bool) -> str:
    """Errors on held-out recordings."""
    after = f"validation after {count(step, 'step')}"
    if not result.pairs:
        return f"{after}: no held-out pair could be aligned, so there is nothing to compare with"
    covered = ", ".join(f"{percent:.0f}" for percent in result.covered_percent)
    return (
        f"{after}: {format_errors(result)} from scan to scan, over {count(result.pairs, 'pair')};"
        f" {covered} % of the errors within 1, 2, 3 standard deviations{'; the best so far' if improves else ''}"
    )


def format_errors(result: Validation) -> str:
    """Errors of the motions."""
    return (
        f"off by {result.rotation_rms_deg:.3f} deg and {result.translation_rms_m:.3f} m RMS"
        f" (median {result.rotation_median_deg:.3f} deg, {result.translation_median_m:.3f} m)"
    )


def format_outcome(out: Path, weights: Path, steps: int, best: Validation | None, is_interrupted: bool) -> str:
    """The path of the weights, their errors, and the commands that use them."""
    errors = "" if best is None else f", on held-out scans {format_errors(best)}"
    lines = [
        f"{count(steps, 'step')} done; weights written to {weights}{errors}",
        f"use them:   {as_typed('lidarslam')} run SOURCE --weights {weights}",
        f"curves:     {as_typed('tensorboard')} --logdir {out / 'tensorboard'}",
    ]
    if is_interrupted:
        lines.append(f"go on:      {as_typed('lidarslam')} train --out {out} --resume")
    return "\n".join(lines)
