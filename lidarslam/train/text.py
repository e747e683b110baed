"""How a training is told on the console."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from lidarslam.run.progress import show_count
from lidarslam.train.request import Material, StepReport, TrainNarrator, TrainOutcome
from odometry.training.training import Validation

Say = Callable[[str], None]


class ConsoleNarrator(TrainNarrator):
    """A bar while recordings are prepared, then a line for each line of the log."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._bar = ExitStack()
        self._count: Callable[[int, int], None] | None = None

    def preparing(self, done: int, total: int) -> None:
        """Move the bar."""
        if self._count is None:
            self._count = self._bar.enter_context(show_count("preparing recordings"))
        self._count(done, total)

    def material(self, material: Material) -> None:
        """Say what is trained on."""
        self._bar.close()
        self._say(format_material(material))

    def going_on(self, step: int) -> None:
        """Say where an earlier training is taken up."""
        self._say(f"going on after step {step:,}")

    def stepped(self, report: StepReport) -> None:
        """Say how the loss goes."""
        self._say(format_step(report))

    def validated(self, step: int, result: Validation, is_best: bool) -> None:
        """Say how good the network is."""
        self._say(format_validation(step, result, is_best))

    def close(self) -> None:
        """Take the bar away, should it still be there."""
        self._bar.close()


def format_material(material: Material) -> str:
    """One line."""
    simulated = f", {material.simulated:,} of them simulated" if material.simulated else ""
    held_out = f"{material.held_out_scans:,} more are held out for validation" if material.held_out_scans else (
        "none is held out for validation"
    )  # fmt: skip
    processes = f" in {material.processes} processes" if material.processes > 1 else ""
    recordings = f"{material.recordings:,} recording{'s' if material.recordings > 1 else ''}"
    return (
        f"training on {recordings}{simulated}: {material.scans:,} scans to learn from, {held_out};"
        f" {material.believed_percent:.0f} % of consecutive scans could be aligned. Computing on"
        f" {material.device}{processes}"
    )


def format_step(report: StepReport) -> str:
    """One line; parts of the loss that are switched off are left out."""
    parts = ", ".join(
        f"{name.replace('_', '-')} {value:.4g}" for name, value in report.losses.items() if name != "total" and value
    )
    return (
        f"step {report.step:,}/{report.steps:,}  loss {report.losses['total']:.4g} ({parts})"
        f"  {report.pairs_per_s:.1f} pairs/s  {format_time(report.left_s)} left"
    )


def format_validation(step: int, result: Validation, is_best: bool) -> str:
    """One line."""
    if not result.pairs:
        return (
            f"validation after {step:,} steps: no held-out pair could be aligned, so there is nothing to compare with"
        )
    covered = ", ".join(f"{percent:.0f}" for percent in result.covered_percent)
    return (
        f"validation after {step:,} steps: {format_errors(result)} from scan to scan, over {result.pairs:,} pairs;"
        f" {covered} % of the errors within 1, 2, 3 of the standard deviations it gives"
        f"{'; the best so far' if is_best else ''}"
    )


def format_errors(result: Validation) -> str:
    """How far off the motions are."""
    return (
        f"off by {result.rotation_rms_deg:.3f} deg and {result.translation_rms_m:.3f} m RMS"
        f" (median {result.rotation_median_deg:.3f} deg, {result.translation_median_m:.3f} m)"
    )


def format_outcome(out: Path, outcome: TrainOutcome) -> str:
    """Where the weights lie, how good they are and how they are used."""
    best = "" if outcome.best is None else f", on held-out scans {format_errors(outcome.best)}"
    lines = [
        f"{outcome.steps:,} steps done; weights written to {outcome.weights}{best}",
        f"use them:   lidarslam run SOURCE --out RUN --odometry learned --weights {outcome.weights}",
        f"curves:     tensorboard --logdir {out / 'tensorboard'}",
    ]
    if outcome.interrupted:
        lines.append(f"go on:      lidarslam train --out {out} --resume")
    return "\n".join(lines)


def format_time(seconds: float) -> str:
    """Hours and minutes, or minutes and seconds."""
    whole = math.ceil(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{whole} s"
