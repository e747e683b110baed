"""Aligning from several guesses, and further afield where none of them will do."""

from torch import Tensor

from odometry.alignment import Aligned, align
from odometry.alignment_config import AlignmentConfig
from odometry.sweeps import SweepPairs
from odometry.torch_geometry import inverse, log

# The many guesses of a search are tried roughly; the best is aligned anew.
_ROUGH = {"column_step": 6, "iterations": 6}
# Guesses that differ by less than this lead to the same place.
_LIKE_RAD, _LIKE_M = 0.05, 0.5


def align_best(
    guesses: Tensor, sweeps: SweepPairs, config: AlignmentConfig, information: Tensor | None = None
) -> tuple[Aligned, bool]:
    """The alignment of one scan on another (B = 1) that explains most, and whether it began from the first guess.

    Guesses that differ are tried roughly, of which the best is refined; a later one must do clearly better. Where the
    scans still agree on too little, steps along the direction in doubt are tried; the less likely the first guess makes
    what is found there, the more must be agreed on for it.

    Args:
        guesses: (K, 4, 4) of T_prev_curr, the most likely first.
        sweeps: one pair.
        config: how.
        information: (1, 6, 6) inverse covariance of the first guess.
    """
    choice = _choose(guesses, sweeps, config)
    is_first = choice == slice(0, 1)
    best = align(guesses[choice], sweeps, config, information if is_first else None)
    if float(best.explained) >= config.doubtful or not config.search_m:
        return best, is_first
    other = try_instead(best, _along(best, config.search_m), sweeps, config)
    if other is None or _gain(best, other) <= config.clearly_better * _away(other, guesses[:1], information):
        return best, is_first
    return other, False


def try_instead(best: Aligned, guesses: Tensor, sweeps: SweepPairs, config: AlignmentConfig) -> Aligned | None:
    """The alignment from the most promising of many guesses (K, 4, 4), if it does clearly better than the best."""
    found = try_guesses(guesses, sweeps, config)
    other = align(found, sweeps, config)
    return other if _gain(best, other) > config.clearly_better else None


def _gain(best: Aligned, other: Aligned) -> float:
    return float(other.explained) - float(best.explained)


def _away(aligned: Aligned, guess: Tensor, information: Tensor | None) -> float:
    """How many standard deviations of the guess (1, 4, 4) the motion lies from it; 0 where those are not known."""
    if information is None:
        return 0.0
    away = log(aligned.T_prev_curr @ inverse(guess))[0].to(information)
    return float((away @ information[0] @ away).sqrt())


def _choose(guesses: Tensor, sweeps: SweepPairs, config: AlignmentConfig) -> slice:
    """Which guess to begin from: the first, unless another is not like it and does clearly better."""
    away = log(guesses @ inverse(guesses[:1]))
    if bool((away[:, :3].norm(dim=1) < _LIKE_RAD).all() and (away[:, 3:].norm(dim=1) < _LIKE_M).all()):
        return slice(0, 1)
    explained = _rough(guesses, sweeps, config).explained
    explained[0] += config.clearly_better
    best = int(explained.argmax())
    return slice(best, best + 1)


def try_guesses(guesses: Tensor, sweeps: SweepPairs, config: AlignmentConfig) -> Tensor:
    """The (1, 4, 4) of many guesses (K, 4, 4) that explains most, roughly aligned."""
    tried = _rough(guesses, sweeps, config)
    best = tried.explained.argmax()
    return tried.T_prev_curr[best : best + 1]


def _rough(guesses: Tensor, sweeps: SweepPairs, config: AlignmentConfig) -> Aligned:
    return align(guesses, sweeps.repeat(len(guesses)), config.model_copy(update=_ROUGH))


def _along(aligned: Aligned, distances_m: tuple[float, ...]) -> Tensor:
    """(K, 4, 4) the motion, moved to and fro along the direction in doubt."""
    steps = aligned.weakest.new_tensor([sign * distance for distance in distances_m for sign in (1.0, -1.0)])
    guesses = aligned.T_prev_curr.repeat(len(steps), 1, 1)
    guesses[:, :3, 3] += steps[:, None] * aligned.weakest
    return guesses
