"""The learned odometry on a mixture of recordings that training never saw: every world, sensor, carrier and mounting.

    python benchmarks/odometry_mixture.py --recordings 72 --scans 40 --seed 77

Recordings are drawn as for training, by another seed, so that worlds, routes and noise are others. Prints Markdown
tables: errors of the motions between the stamps of consecutive scans, all recordings together and by world, sensor and
carrier; and how many of the errors lie within one, two and three standard deviations of the covariance that comes with
them, which should be 68.3, 95.4 and 99.7 % (for six directions together, by the chi-squared distribution). A motion
counts as failed when the odometry says so itself; the errors are those of the others.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mapping_accuracy import BEYOND_TRUTH_S, print_row
from numpy.typing import NDArray
from odometry_accuracy import EXPECTED_SHARES, SIGMAS, network_alone, rms, shares_within_sigmas, squared_errors

from lidarslam.core.geometry import FloatArray, inverse, log, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.odometry.config import LearnedConfig, OdometryConfig
from lidarslam.odometry.registry import make_odometry
from lidarslam.simulation.mixture import Excerpt, mixture
from lidarslam.simulation.recorder import Simulation

# What a motion should be better than: degrees, metres, and part of the step.
_GOOD_DEG, _GOOD_M, _GOOD_SHARE = 0.3, 0.02, 0.03
_FASTEST_DEG = 15.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """One recording: what it is, and for each of its motions that were measured, (N,) or (N, 6).

    Attributes:
        world, sensor, carrier: its kind.
        step_m, turn_deg: (N,) of the truth.
        error: (N, 6) of the estimate, in its own frame.
        squared: (N,) squared error in standard deviations, summed over the six directions; NaN without covariance.
        failed: how many motions were not measured.
        cpu_ms: processor time a scan.
    """

    world: str
    sensor: str
    carrier: str
    step_m: FloatArray
    turn_deg: FloatArray
    error: FloatArray
    squared: FloatArray
    failed: int
    cpu_ms: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=72)
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--weights", type=Path, help="instead of the program's own")
    options = parser.parse_args(arguments)
    methods = {"network alone": network_alone(options.weights), "learned": LearnedConfig(weights=options.weights)}
    outcomes: dict[str, list[Outcome]] = {name: [] for name in methods}
    for excerpt in mixture(options.recordings, options.scans, options.seed):
        scans = list(excerpt.scans())
        for name, config in methods.items():
            outcomes[name].append(_try(config, excerpt, scans))
    for name, found in outcomes.items():
        _print_accuracy(name, found)
    _print_coverage("learned", outcomes["learned"])


def _try(config: LearnedConfig, excerpt: Excerpt, scans: Sequence[Scan]) -> Outcome:
    simulation = excerpt.whole
    assert isinstance(simulation, Simulation)
    odometry = make_odometry(OdometryConfig(learned=config))
    started = time.process_time()
    try:
        motions = [odometry.estimate(scan) for scan in scans]
    finally:
        odometry.close()
    cpu_ms = 1e3 * (time.process_time() - started) / len(motions)
    truth = simulation.ground_truth.at(np.array([scan.stamp for scan in scans]), BEYOND_TRUTH_S)
    true = inverse(truth[:-1]) @ truth[1:]
    estimated = np.array([motion.T_prev_curr for motion in motions[1:]])
    measured = np.array([motion.failure is None for motion in motions[1:]])
    error = log(inverse(estimated) @ true)
    squared = squared_errors([motion.covariance for motion in motions[1:]], error)
    return Outcome(
        simulation.world.name, simulation.sensor.name, simulation.motion.name,
        np.linalg.norm(true[measured, :3, 3], axis=1), np.rad2deg(rotation_angle(true[measured])), error[measured],
        squared[measured], int((~measured).sum()), cpu_ms,
    )  # fmt: skip


def _print_accuracy(name: str, outcomes: Sequence[Outcome]) -> None:
    print(f"\n{name}: RMS of the errors of motions; turns over {_FASTEST_DEG:g} degrees a scan are left out\n")
    header = ["", "recordings", "step, m", "turn, deg", "rotation, deg", "translation, cm", "% of the step"]
    print_row(
        [*header, f"rotation under {_GOOD_DEG:g} deg", "translation under 2 cm or 3 %", "failed", "CPU, ms a scan"]
    )
    print_row(["---"] * 11)
    _print_group("all", outcomes)
    kinds: dict[str, Callable[[Outcome], str]] = {
        "world": lambda one: one.world,
        "sensor": lambda one: one.sensor,
        "carrier": lambda one: one.carrier,
    }
    for kind, of in kinds.items():
        for value in sorted({of(one) for one in outcomes}):
            _print_group(f"{kind} {value}", [one for one in outcomes if of(one) == value])


def _print_group(name: str, outcomes: Sequence[Outcome]) -> None:
    """Errors of all motions together, and how many of the recordings are as good as they should be."""
    parts = [(one, one.turn_deg <= _FASTEST_DEG) for one in outcomes]
    error = np.concatenate([one.error[slow] for one, slow in parts])
    step_m = rms(np.concatenate([one.step_m[slow] for one, slow in parts]))
    turn_deg = rms(np.concatenate([one.turn_deg[slow] for one, slow in parts]))
    translation_m = rms(np.linalg.norm(error[:, 3:], axis=1))
    good = np.array([_is_good(one, slow) for one, slow in parts])
    print_row([
        name, str(len(outcomes)), f"{step_m:.2f}", f"{turn_deg:.1f}",
        f"{np.rad2deg(rms(np.linalg.norm(error[:, :3], axis=1))):.2f}", f"{100.0 * translation_m:.1f}",
        f"{100.0 * translation_m / step_m:.0f}", *(f"{good[:, i].sum()} of {len(good)}" for i in range(2)),
        str(sum(one.failed for one in outcomes)), f"{np.median([one.cpu_ms for one in outcomes]):.0f}",
    ])  # fmt: skip


def _is_good(outcome: Outcome, chosen: NDArray[np.bool_]) -> tuple[bool, bool]:
    """Whether a recording's rotations, and its translations, are as good as they should be."""
    error = outcome.error[chosen]
    if not len(error):
        return True, True
    rotation_deg = np.rad2deg(rms(np.linalg.norm(error[:, :3], axis=1)))
    translation_m = rms(np.linalg.norm(error[:, 3:], axis=1))
    return bool(rotation_deg <= _GOOD_DEG), bool(
        translation_m <= max(_GOOD_M, _GOOD_SHARE * rms(outcome.step_m[chosen]))
    )


def _print_coverage(name: str, outcomes: Sequence[Outcome]) -> None:
    squared = np.concatenate([one.squared for one in outcomes])
    squared = squared[np.isfinite(squared)]
    print(f"\n{name}: errors within so many standard deviations, {len(squared)} motions\n")
    print_row(["", *(str(sigma) for sigma in SIGMAS)])
    print_row(["---"] * 4)
    print_row(["should be, %", *(f"{100.0 * share:.1f}" for share in EXPECTED_SHARES)])
    print_row(["are, %", *(f"{100.0 * share:.1f}" for share in shares_within_sigmas(squared))])


if __name__ == "__main__":
    main()
