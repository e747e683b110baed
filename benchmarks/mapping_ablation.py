"""Ablation of scan-to-map registration: the same recordings with parts of it disabled.

    python benchmarks/mapping_ablation.py

The rows of the Markdown table are variants: surfels and LOAM's features, with the velocity of the sweep estimated
(continuous time) or taken from the poses (discrete); each without an odometry, with the learned one, and with one that
is wrong at every scan (see `mapping_accuracy.py`). The columns are the ATE of each recording in metres after SE(3)
alignment, with lost scans in brackets, the mean, and the median time of registration and map update per scan. All
variants have the same scans; the results of each recording go to standard error during the run.
"""

import sys
from collections.abc import Sequence

import numpy as np
from mapping_accuracy import (
    Outcome,
    Recorded,
    add_simulation_arguments,
    config_of,
    localise,
    make_parser,
    print_header,
    print_row,
    simulated_recordings,
    wrong_odometry,
)

from lidarslam.mapping.config import MappingConfig

_PARTS: dict[str, MappingConfig] = {
    "surfels, continuous time (default)": MappingConfig(),
    "surfels, discrete": MappingConfig(continuous_time=False),
    "LOAM, continuous time": MappingConfig(method="loam"),
    "LOAM, discrete": MappingConfig(method="loam", continuous_time=False),
}


def run_variants(recorded: Recorded, seed: int) -> list[Outcome]:
    """All variants on one recording: without an odometry, with the learned and with the wrong one."""
    prior, mappings = wrong_odometry(recorded, seed), _PARTS.values()
    alone = [localise(recorded, config_of("constant-velocity", mapping)) for mapping in mappings]
    learned = [localise(recorded, config_of("learned", mapping)) for mapping in mappings]
    return alone + learned + [localise(recorded, config_of("external", mapping), prior) for mapping in mappings]


def _labels() -> list[str]:
    """Variants in the order of `run_variants`."""
    return [f"{name} | {odometry}" for odometry in ("none", "learned", "wrong") for name in _PARTS]


def _cells(outcomes: Sequence[Outcome]) -> list[str]:
    ates = [f"{outcome.ate_m:.3f}" + (f" ({outcome.lost})" if outcome.lost else "") for outcome in outcomes]
    refine_ms = [outcome.refine_ms for outcome in outcomes if outcome.refine_ms is not None]
    return [*ates, f"{np.mean([outcome.ate_m for outcome in outcomes]):.3f}", f"{np.median(refine_ms):.1f}"]


def main() -> None:
    parser = make_parser(__doc__)
    add_simulation_arguments(parser, ("office", "tunnel", "hall"), ("handheld", "legged", "tracked"))
    arguments = parser.parse_args()
    names: list[str] = []
    columns: list[list[Outcome]] = []
    for recorded in simulated_recordings(arguments):
        names.append(recorded.name)
        columns.append(run_variants(recorded, arguments.seed))
        ates = " ".join(f"{outcome.ate_m:.3f}" for outcome in columns[-1])
        print(f"{recorded.name}: {ates}", file=sys.stderr, flush=True)
    header = ["variant", "odometry", *names, "mean", "ms per scan"]
    print_header(header)
    for label, outcomes in zip(_labels(), zip(*columns, strict=True), strict=True):
        print_row([label, *_cells(outcomes)])


if __name__ == "__main__":
    main()
