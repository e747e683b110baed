"""What variety of training data buys on worlds and sensors never seen, and what a larger network does.

    python benchmarks/training_ablation.py --out ablation
    python benchmarks/training_ablation.py --out ablation --of sizes

Trains the default network again and again, with equal steps, on parts of one mixture of simulated recordings: one world
and one sensor, more worlds, more sensors, and both. Tests every network, alone and without alignment, on other
recordings of that mixture: of worlds and sensors that are among the training's, of worlds never trained on, of sensors
never trained on, and of neither. Then networks of several sizes, trained on all, with the time that each takes for a
scan; `--plot` draws error over time. Prints Markdown tables; what was prepared and trained already is not done again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from mapping_accuracy import print_row
from network_speed import time_pair

from evaluation.figures.panel import Panel, draw_panel, scale_ticks, text
from evaluation.figures.scale import Scale, tick_texts, ticks
from evaluation.markup import element
from lidarslam.simulation.mixture import Ingredients, ingredients_of
from lidarslam.train import execute
from lidarslam.train_config import SimulatedConfig, TrainConfig
from lidarslam.train_request import TrainNarrator, TrainRequest
from lidarslam.training_data import prepared, simulated
from odometry.checkpoint import load_checkpoint, network_of
from odometry.image_config import ImageConfig
from odometry.network_config import CorrelationConfig, NetworkConfig
from odometry.networks import PairNetwork
from odometry.preparation import PreparedRecording
from odometry.training import Validation, validate
from odometry.training_config import TrainingConfig

_WORLDS = ("street", "office", "tunnel", "park")
_SENSORS = ("vlp-16", "hdl-64e", "os1-128", "os1-64", "hdl-32e")
# Worlds and sensors that each network learns from; None: all there are.
_VARIETIES: dict[str, tuple[Sequence[str] | None, Sequence[str] | None]] = {
    "one world, one sensor": (("office",), ("vlp-16",)),
    "one world, five sensors": (("office",), _SENSORS),
    "four worlds, one sensor": (_WORLDS, ("vlp-16",)),
    "four worlds, five sensors": (_WORLDS, _SENSORS),
    "all six worlds, all eight sensors": (None, None),
}
_SIZES = {
    "small": CorrelationConfig(widths=(16, 24, 32), pair_width=32),
    "default": CorrelationConfig(),
    "large": CorrelationConfig(widths=(32, 64, 96), pair_width=96),
}
_TESTS = ("seen worlds and sensors", "unseen worlds", "unseen sensors", "both unseen")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train what is not trained yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="trainings are kept here")
    parser.add_argument("--prepared", type=Path, help="recordings made ready are kept here  [default: in --out]")
    parser.add_argument("--of", choices=("variety", "sizes", "both"), default="both")
    parser.add_argument("--plot", type=Path, help="an .svg file: sizes, error over time")
    parser.add_argument("--recordings", type=int, default=150, help="of the mixture, to learn from")
    parser.add_argument("--test", type=int, default=42, help="the ones after them, to test on")
    parser.add_argument("--scans", type=int, default=48)
    parser.add_argument("--steps", type=int, default=1000)
    options = parser.parse_args(arguments)
    options.prepared = options.prepared or options.out / "prepared"
    tests = _tests(options)
    if options.of in ("variety", "both"):
        _print_variety(options, tests)
    if options.of in ("sizes", "both"):
        _print_sizes(options, tests)


def _tests(options: argparse.Namespace) -> dict[str, list[PreparedRecording]]:
    """The recordings after those that are learned from, by what of them training sees where it does not see all."""
    config = SimulatedConfig(recordings=options.recordings + options.test, scans=options.scans)
    stretches = simulated(config)[options.recordings :]
    made = prepared(stretches, ImageConfig(), options.prepared, lambda _: None)
    tests: dict[str, list[PreparedRecording]] = {name: [] for name in _TESTS}
    for number, recording in enumerate(made, options.recordings):
        tests[_TESTS[_novelty(ingredients_of(number, config.seed))]].append(recording)
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
        network = _trained(name, data, NetworkConfig(), options)
        errors = [_errors(network, recordings) for recordings in tests.values()]
        print_row([name, str(len(simulated(data))), *errors])


def _print_sizes(options: argparse.Namespace, tests: dict[str, list[PreparedRecording]]) -> None:
    everything = [recording for recordings in tests.values() for recording in recordings]
    print("\nOne scan encoded and one pair compared, one thread; errors on all the recordings tested\n")
    print_row(["network", "widths", "parameters", "CPU, ms", "RMS, median: deg; cm"])
    print_row(["---"] * 5)
    data = SimulatedConfig(recordings=options.recordings, scans=options.scans)
    drawn = []
    for name, size in _SIZES.items():
        label = "all six worlds, all eight sensors" if name == "default" else f"{name} network"
        network = _trained(label, data, NetworkConfig(correlation=size), options)
        parameters = sum(p.numel() for p in network.parameters())
        widths = f"{', '.join(map(str, size.widths))}; {size.pair_width}"
        _, cpu_ms = time_pair(network, rows=16, columns=720, repeats=30)
        print_row([name, widths, f"{parameters:,}", f"{cpu_ms:.1f}", _errors(network, everything)])
        drawn.append((name, cpu_ms, 100.0 * _validated(network, everything).translation_rms_m))
    if options.plot is not None:
        options.plot.write_text(_plot(drawn), encoding="utf-8")


def _plot(sizes: Sequence[tuple[str, float, float]]) -> str:
    """Error (cm) over time (ms) as SVG, a dot with its name for each network."""
    times, errors = (np.array(values) for values in list(zip(*sizes, strict=True))[1:])
    width, height = 420.0, 220.0
    x = Scale(0.0, 1.25 * float(times.max()), 0.0, width)
    y = Scale(0.0, 1.25 * float(errors.max()), height, 0.0)
    x_values, y_values = ticks(x.low, x.high), ticks(y.low, y.high)
    panel = Panel(
        "RMS error of the translation, cm", "Error of networks of several sizes over the time they take", width, height,
        "processor time for a scan, ms",
        scale_ticks(x, x_values.tolist(), tick_texts(x_values)),
        scale_ticks(y, y_values.tolist(), tick_texts(y_values)),
    )  # fmt: skip
    dots = [element("circle", cx=x.at(ms), cy=y.at(cm), r=5.0, fill="#0072b2") for _, ms, cm in sizes]
    names = [text(name, x.at(ms) + 9.0, y.at(cm) + 4.0) for name, ms, cm in sizes]
    return draw_panel(panel, dots, names)


def _trained(name: str, data: SimulatedConfig, network: NetworkConfig, options: argparse.Namespace) -> torch.nn.Module:
    """A network after so many steps on this data."""
    out = options.out / name.replace(",", "").replace(" ", "_")
    training = TrainingConfig(
        network=network, geometric=None, steps=options.steps, batch=8, warmup_steps=100, hold_out=0.0
    )
    config = TrainConfig(simulated=data, training=training)
    if not (out / "weights.safetensors").exists():
        execute(TrainRequest((), out, config, prepared=options.prepared, resume=out.exists()), TrainNarrator())
    return network_of(load_checkpoint(out / "weights.safetensors"))


def _errors(network: torch.nn.Module, recordings: Sequence[PreparedRecording]) -> str:
    found = _validated(network, recordings)
    return (
        f"{found.rotation_rms_deg:.2f}, {found.rotation_median_deg:.2f};"
        f" {100.0 * found.translation_rms_m:.1f}, {100.0 * found.translation_median_m:.1f}"
    )


def _validated(network: torch.nn.Module, recordings: Sequence[PreparedRecording]) -> Validation:
    return validate(cast(PairNetwork, network), recordings)


if __name__ == "__main__":
    main()
