"""Aligning from several guesses, and further afield where none of them will do."""

import torch
from torch import Tensor

from odometry.alignment import Aligned, SweepImages, align
from odometry.alignment_config import AlignmentConfig
from odometry.torch_geometry import inverse, log

# The many guesses of a search are tried roughly; the best is aligned anew.
_ROUGH = {"column_step": 6, "iterations": 6}
# Guesses that differ by less than this lead to the same place.
_LIKE_RAD, _LIKE_M = 0.05, 0.5


def align_best(
    guesses: Tensor,
    current: SweepImages,
    previous: SweepImages,
    interval_s: Tensor,
    config: AlignmentConfig,
    information: Tensor | None = None,
) -> tuple[Aligned, bool]:
    """The alignment of one scan on another (B = 1) that explains most, and whether it began from the first guess.

    Guesses that differ are tried roughly, of which the best is refined; a later one must do clearly better. Where the
    scans still agree on too little, steps along the direction in doubt are tried.

    Args:
        guesses: (K, 4, 4) of T_prev_curr, the most likely first.
        current, previous, interval_s: as in `align`, one of each.
        config: how.
        information: (1, 6, 6) inverse covariance of the first guess.
    """
    choice = _choose(guesses, current, previous, interval_s, config)
    is_first = choice == slice(0, 1)
    best = align(guesses[choice], current, previous, interval_s, config, information if is_first else None)
    if float(best.explained) >= config.doubtful or not config.search_m:
        return best, is_first
    other = try_instead(best, _along(best, config.search_m), current, previous, interval_s, config)
    return (best, is_first) if other is None else (other, False)


def try_instead(
    best: Aligned,
    guesses: Tensor,
    current: SweepImages,
    previous: SweepImages,
    interval_s: Tensor,
    config: AlignmentConfig,
) -> Aligned | None:
    """The alignment from the most promising of many guesses (K, 4, 4), if it does clearly better than the best."""
    found = try_guesses(guesses, current, previous, interval_s, config)
    other = align(found, current, previous, interval_s, config)
    return other if float(other.explained) > float(best.explained) + config.clearly_better else None


def _choose(
    guesses: Tensor, current: SweepImages, previous: SweepImages, interval_s: Tensor, config: AlignmentConfig
) -> slice:
    """Which guess to begin from: the first, unless another is not like it and does clearly better."""
    away = log(guesses @ inverse(guesses[:1]))
    if bool((away[:, :3].norm(dim=1) < _LIKE_RAD).all() and (away[:, 3:].norm(dim=1) < _LIKE_M).all()):
        return slice(0, 1)
    explained = _rough(guesses, current, previous, interval_s, config).explained
    explained[0] += config.clearly_better
    best = int(explained.argmax())
    return slice(best, best + 1)


def try_guesses(
    guesses: Tensor, current: SweepImages, previous: SweepImages, interval_s: Tensor, config: AlignmentConfig
) -> Tensor:
    """The (1, 4, 4) of many guesses (K, 4, 4) that explains most, roughly aligned."""
    tried = _rough(guesses, current, previous, interval_s, config)
    best = tried.explained.argmax()
    return tried.T_prev_curr[best : best + 1]


def _rough(
    guesses: Tensor, current: SweepImages, previous: SweepImages, interval_s: Tensor, config: AlignmentConfig
) -> Aligned:
    many = torch.zeros(len(guesses), dtype=torch.int64, device=guesses.device)
    rough = config.model_copy(update=_ROUGH)
    return align(guesses, current.select(many), previous.select(many), interval_s[many], rough)


def _along(aligned: Aligned, distances_m: tuple[float, ...]) -> Tensor:
    """(K, 4, 4) the motion, moved to and fro along the direction in doubt."""
    steps = aligned.weakest.new_tensor([sign * distance for distance in distances_m for sign in (1.0, -1.0)])
    guesses = aligned.T_prev_curr.repeat(len(steps), 1, 1)
    guesses[:, :3, 3] += steps[:, None] * aligned.weakest
    return guesses
