"""The lines of a training on the console."""

import math
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path

from lidarslam.core.text.plain_text import as_typed, count
from lidarslam.odometry.training.training import Validation


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
