"""The directory of a training: its files, its log, and the state from which it resumes without a difference."""

import csv
import math
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from io import SEEK_END, TextIOWrapper
from pathlib import Path

import torch
from pydantic import TypeAdapter
from torch import Tensor, nn
from torch.utils.tensorboard.writer import SummaryWriter

from lidarslam.config.settings import SOURCES_SECTION
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import make_own_folder, open_own, replacing
from lidarslam.core.text import as_typed, count, one_line
from lidarslam.odometry.network.checkpoint import Kind, read_tensor_file, write_tensor_file
from lidarslam.odometry.training.losses import Validation
from lidarslam.storage.directory import config_begins_with

CONFIG = "config.yaml"
WEIGHTS = "weights.safetensors"
LAST_WEIGHTS = "weights_last.safetensors"
STATE = "state.safetensors"
LOSSES = "train.csv"
VALIDATION = "validation.csv"
CURVES = "tensorboard"
PREPARED = "prepared"

# Prepared recordings are no results: another training in the directory uses them again.
RESULTS = (CONFIG, WEIGHTS, LAST_WEIGHTS, STATE, LOSSES, VALIDATION, CURVES)


def earlier_training(path: Path, resume: bool, overwrite: bool) -> list[str]:
    """The files of a training in the directory, if it may be resumed or replaced.

    OutputError where it holds a training and neither is asked for, holds other files of these names, or there is none
    to resume.
    """
    present = [name for name in RESULTS if (path / name).exists()]
    listed = f"{', '.join(present[:3])}{', ...' if len(present) > 3 else ''}"
    if present and not is_training(path):
        raise OutputError(f"{path}: holds files that are not those of a training ({listed}); name another directory")
    if resume and not present:
        raise OutputError(f"{path}: holds no training to go on with; leave --resume out to begin one")
    if present and not resume and not overwrite:
        raise OutputError(
            f"{path}: holds a training already ({listed}); name another directory, go on with it by --resume,"
            " or replace it with --overwrite"
        )
    return present


def remove_results(path: Path, names: Iterable[str]) -> None:
    """Make room for another training; the remains of a killed one can neither be resumed nor are they foreign."""
    for name in sorted(names, key=lambda name: (name == CONFIG, name != STATE)):
        if (path / name).is_dir() and not (path / name).is_symlink():
            shutil.rmtree(path / name)
        else:
            (path / name).unlink()


def is_training(path: Path) -> bool:
    """Whether the directory is of a training: the first section of its configuration names the recordings."""
    return config_begins_with(path, SOURCES_SECTION)


_KIND = Kind("the state of a training", version=1)
_NETWORK, _OPTIMIZER = "network", "optimizer"


@dataclass
class Progress:
    """The state other than weights and moments."""

    step: int = 0  # number of steps done
    best: float | None = None  # the lowest score of a validation so far, None before the first
    sums: dict[str, float] = field(default_factory=dict)  # of each part of the loss since the last line of the log
    counted: int = 0  # number of these steps
    data: str = ""  # digest of the recordings


def save_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, progress: Progress) -> None:
    """Write the file, whole or not at all; OutputError where it cannot be written."""
    tensors: dict[str, Tensor] = {f"{_NETWORK}/{name}": value for name, value in network.state_dict().items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"{_OPTIMIZER}/{number}/{name}": torch.as_tensor(value) for name, value in moments.items()}
    write_tensor_file(path, _KIND, tensors, vars(progress))


def load_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
    """Restore weights and moments; the network and the optimizer must be as they were made.

    InputError where the file is not usable, or belongs to another network.
    """
    tensors, content = read_tensor_file(path, _KIND)
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    weights, moments = dict[str, Tensor](), dict[int, dict[str, Tensor]]()
    try:
        for name, tensor in tensors.items():
            of, _, rest = name.partition("/")
            if of == _NETWORK:
                weights[rest] = tensor
                continue
            number, _, key = rest.partition("/")
            if tensor.shape not in (torch.Size(), parameters[int(number)].shape):
                raise ValueError(f"{name} has the shape {tuple(tensor.shape)}")
            moments.setdefault(int(number), {})[key] = tensor
        network.load_state_dict(weights)
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
        return TypeAdapter(Progress).validate_python(content)
    except (RuntimeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: does not belong to this network; go on with the configuration it was begun with"
            f" ({one_line(str(error))[:200]})"
        ) from error


class TrainingLog:
    """Appends to the tables; lines after the step that the training resumes from are dropped, all of a new one."""

    def __init__(self, out: Path, step: int | None) -> None:
        self._out = out
        for name in (LOSSES, VALIDATION):
            _cut(out / name, -1 if step is None else step)
        make_own_folder(out / CURVES)
        self._curves = SummaryWriter(str(out / CURVES), purge_step=step + 1 if step else None)

    def losses(self, step: int, row: Mapping[str, float]) -> None:
        self._write(LOSSES, "training", step, row)

    def validation(self, step: int, result: Validation) -> None:
        values = vars(result).copy()
        for k, percent in enumerate(values.pop("covered_percent"), start=1):
            values[f"covered_{k}_sigma_percent"] = percent
        self._write(VALIDATION, "validation", step, values)
        self._curves.flush()

    def close(self) -> None:
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
    return (
        f"off by {result.rotation_rms_deg:.3f} deg and {result.translation_rms_m:.3f} m RMS"
        f" (median {result.rotation_median_deg:.3f} deg, {result.translation_median_m:.3f} m)"
    )


def format_outcome(out: Path, step: int, kept_step: int, best: Validation | None, is_interrupted: bool) -> str:
    """The path of the weights, their step and errors, and the commands that use them."""
    weights = out / WEIGHTS
    errors = "" if best is None else f", on held-out scans {format_errors(best)}"
    of_step = "" if kept_step == step else f" of step {kept_step:,}"
    lines = [
        f"{count(step, 'step')} done; weights{of_step} written to {weights}{errors}",
        f"use them:   {as_typed('lidarslam')} run SOURCE --weights {weights}",
        f"curves:     {as_typed('tensorboard')} --logdir {out / 'tensorboard'}",
    ]
    if is_interrupted:
        lines.append(f"go on:      {as_typed('lidarslam')} train --out {out} --resume")
    return "\n".join(lines)
