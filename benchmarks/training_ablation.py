"""What variety of training data buys on worlds and sensors never seen.

    python benchmarks/training_ablation.py --out ablation

Trains the default network again and again, with equal steps, on parts of one mixture of simulated recordings: one world
and one sensor, more worlds, more sensors, and both. Tests every network, alone and without alignment, on other
recordings of that mixture: of worlds and sensors that are among the training's, of worlds never trained on, of sensors
never trained on, and of neither. Prints a Markdown table; what was prepared and trained already is not done again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from mapping_accuracy import print_row

from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of
from lidarslam.odometry.training.config import SimulatedConfig, TrainingConfig
from lidarslam.odometry.training.preparation import PreparedRecording
from lidarslam.odometry.training.training import validate
from lidarslam.simulation.mixture import Ingredients, ingredients_of
from lidarslam.train.data import prepared, simulated
from lidarslam.train.settings import TrainConfig
from lidarslam.train.train import TrainRequest, execute

_WORLDS = ("street", "office", "tunnel", "park")
_SENSORS = ("vlp-16", "hdl-64e", "os1-128", "os1-64", "hdl-32e")
# Worlds and sensors that each network learns from; None: all there are.
_VARIETIES: dict[str, tuple[Sequence[str] | None, Sequence[str] | None]] = {
    "one world, one sensor": (("office",), ("vlp-16",)),
    "one world, five sensors": (("office",), _SENSORS),
    "four worlds, one sensor": (_WORLDS, ("vlp-16",)),
    "four worlds, five sensors": (_WORLDS, _SENSORS),
    "all worlds, all sensors": (None, None),
}
_TESTS = ("seen worlds and sensors", "unseen worlds", "unseen sensors", "both unseen")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train what is not trained yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="trainings are kept here")
    parser.add_argument("--prepared", type=Path, help="recordings made ready are kept here  [default: in --out]")
    parser.add_argument("--recordings", type=int, default=150, help="of the mixture, to learn from")
    parser.add_argument("--test", type=int, default=42, help="the ones after them, to test on")
    parser.add_argument("--scans", type=int, default=48)
    parser.add_argument("--steps", type=int, default=1000)
    options = parser.parse_args(arguments)
    options.prepared = options.prepared or options.out / "prepared"
    _print_variety(options, _tests(options))


def _tests(options: argparse.Namespace) -> dict[str, list[PreparedRecording]]:
    """The recordings after those that are learned from, by what of them training sees where it does not see all."""
    config = SimulatedConfig(recordings=options.recordings + options.test, scans=options.scans)
    stretches = simulated(config)[options.recordings :]
    made = prepared(stretches, TrainingConfig(), options.prepared, lambda _: None)
    tests: dict[str, list[PreparedRecording]] = {name: [] for name in _TESTS}
    for number, recording in enumerate(made, options.recordings):
        tests[_TESTS[_novelty(ingredients_of(number, 0))]].append(recording)
    return tests


def _novelty(of: Ingredients) -> int:
    return int(of.world not in _WORLDS) + 2 * int(of.sensor not in _SENSORS)


def _print_variety(options: argparse.Namespace, tests: dict[str, list[PreparedRecording]]) -> None:
    counts = [f"{name} ({len(recordings)})" for name, recordings in tests.items()]
    print("\nRMS and median of the network's errors, deg and cm; in brackets the recordings tested\n")
    print_row(["trained on", "recordings", *counts])
    print_row(["---"] * (2 + len(counts)))
    for name, (worlds, sensors) in _VARIETIES.items():
        data = SimulatedConfig(
            recordings=options.recordings,
            scans=options.scans,
            worlds=None if worlds is None else tuple(worlds),
            sensors=None if sensors is None else tuple(sensors),
        )
        network = _trained(name, data, options)
        errors = [_errors(network, recordings) for recordings in tests.values()]
        print_row([name, str(len(simulated(data))), *errors])


def _trained(name: str, data: SimulatedConfig, options: argparse.Namespace) -> torch.nn.Module:
    """A network after so many steps on this data."""
    out = options.out / name.replace(",", "").replace(" ", "_")
    training = TrainingConfig(geometric=None, steps=options.steps, batch=8, warmup_steps=100, hold_out=0.0)
    config = TrainConfig(simulated=data, training=training)
    if not (out / "weights.safetensors").exists():
        execute(TrainRequest((), out, config, prepared=options.prepared, resume=out.exists()), print)
    return network_of(load_checkpoint(out / "weights.safetensors"))


def _errors(network: torch.nn.Module, recordings: Sequence[PreparedRecording]) -> str:
    found = validate(network, recordings)
    return (
        f"{found.rotation_rms_deg:.2f}, {found.rotation_median_deg:.2f};"
        f" {100.0 * found.translation_rms_m:.1f}, {100.0 * found.translation_median_m:.1f}"
    )


if __name__ == "__main__":
    main()
