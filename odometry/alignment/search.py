"""Aligning from several guesses, and further afield where none of them will do."""

from collections.abc import Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, log
from odometry.alignment.alignment import Aligned, Guess, align, align_each
from odometry.alignment.alignment_config import AlignmentConfig
from odometry.images.sweeps import SweepPair

# The many guesses of a search are tried roughly; the best is aligned anew.
_ROUGH = {"column_step": 6, "iterations": 6}
# Guesses that differ by less than this lead to the same place.
_LIKE_RAD, _LIKE_M = 0.05, 0.5


def align_best(guesses: Sequence[Guess], sweeps: SweepPair, config: AlignmentConfig) -> Aligned:
    """The alignment of a scan on another that explains most.

    Guesses that differ are tried roughly, of which the best is refined; the less likely one is, the more it must
    explain. Where the scans still agree on too little, steps along the direction in doubt are tried; the less likely
    the guesses make what is found there, the more must be agreed on for it.

    Args:
        guesses: the most likely first.
        sweeps: the pair.
        config: how.
    """
    best = align(guesses[_choose(guesses, sweeps, config)], sweeps, config)
    if best.explained >= config.doubtful or not config.search_m:
        return best
    other = try_instead(best, _along(best, config.search_m), sweeps, config)
    if other is None or _gain(best, other) <= config.clearly_better * _away(other, guesses):
        return best
    return other


def try_instead(
    best: Aligned, guesses: Sequence[FloatArray], sweeps: SweepPair, config: AlignmentConfig
) -> Aligned | None:
    """The alignment from the most promising of many guesses (4, 4), if it does clearly better than the best."""
    other = align(Guess(try_guesses(guesses, sweeps, config)), sweeps, config)
    return other if _gain(best, other) > config.clearly_better else None


def _gain(best: Aligned, other: Aligned) -> float:
    return other.explained - best.explained


def _away(aligned: Aligned, guesses: Sequence[Guess]) -> float:
    """How many standard deviations of the nearest guess the motion lies from it; 0 where none has any."""
    distances = []
    for guess in guesses:
        if guess.information is not None:
            away = log(aligned.T_prev_curr @ inverse(guess.T_prev_curr))
            distances.append(float(np.sqrt(away @ guess.information @ away)))
    return min(distances, default=0.0)


def _choose(guesses: Sequence[Guess], sweeps: SweepPair, config: AlignmentConfig) -> int:
    """Which guess to begin from: the first, unless another is not like it and explains more than its odds ask for."""
    first = inverse(guesses[0].T_prev_curr)
    away = np.array([log(guess.T_prev_curr @ first) for guess in guesses])
    lengths = np.linalg.norm(away.reshape(-1, 2, 3), axis=2)
    if (lengths < (_LIKE_RAD, _LIKE_M)).all():
        return 0
    rough = _rough([guess.T_prev_curr for guess in guesses], sweeps, config)
    scores = [
        aligned.explained - config.clearly_better * guess.odds for aligned, guess in zip(rough, guesses, strict=True)
    ]
    return int(np.argmax(scores))


def try_guesses(guesses: Sequence[FloatArray], sweeps: SweepPair, config: AlignmentConfig) -> FloatArray:
    """The (4, 4) of many guesses (4, 4) that explains most, roughly aligned."""
    return max(_rough(guesses, sweeps, config), key=lambda aligned: aligned.explained).T_prev_curr


def _rough(guesses: Sequence[FloatArray], sweeps: SweepPair, config: AlignmentConfig) -> list[Aligned]:
    return align_each([Guess(guess) for guess in guesses], sweeps, config.model_copy(update=_ROUGH))


def _along(aligned: Aligned, distances_m: tuple[float, ...]) -> list[FloatArray]:
    """The motion (4, 4), moved to and fro along the direction in doubt."""
    guesses = []
    for distance_m in distances_m:
        for sign in (1.0, -1.0):
            T = aligned.T_prev_curr.copy()
            T[:3, 3] += sign * distance_m * aligned.weakest
            guesses.append(T)
    return guesses
