"""From the options of `lidarslam train` to the training."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lidarslam.config.settings import reader_settings
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError
from lidarslam.train.devices import DeviceName
from lidarslam.train.directory import CONFIG, SOURCES_SECTION, is_training
from lidarslam.train.settings import LOSSES, TrainConfig, load_train_config
from lidarslam.train.train import TrainRequest, execute
from odometry.network.shipped import default_weights


@dataclass(frozen=True)
class TrainOptions:
    """The options as they were given; see `lidarslam train --help`."""

    sources: tuple[Path, ...]
    out: Path
    config_file: Path | None
    settings: tuple[str, ...]
    reader: str | None
    topic: str | None
    sequence: str | None
    device: DeviceName
    steps: int | None
    network: str | None
    losses: str | None
    start_from: str | None
    prepared: Path | None
    resume: bool
    overwrite: bool


def run_train(options: TrainOptions, say: Callable[[str], None]) -> bool:
    """Train; whether all steps were done. A training that is resumed is as it was, but for what is given anew.

    Raises:
        LidarSlamError: options contradict each other, a value does not fit, or as `execute`.
    """
    if options.resume and options.overwrite:
        raise ConfigError("--resume goes on with what --overwrite replaces; choose one")
    if options.resume and options.start_from is not None:
        raise ConfigError("--resume goes on with the weights it left; leave --from out")
    earlier = options.out / CONFIG if options.resume and is_training(options.out) else None
    start_from = default_weights() if options.start_from == "shipped" else options.start_from
    request = TrainRequest(
        sources=options.sources or _earlier_sources(earlier),
        out=options.out,
        config=_config(options, earlier),
        start_from=None if start_from is None else Path(start_from),
        device=options.device,
        prepared=options.prepared,
        resume=options.resume,
        overwrite=options.overwrite,
    )
    return execute(request, say)


def _config(options: TrainOptions, earlier: Path | None) -> TrainConfig:
    named = {"training.steps": options.steps, "training.network.name": options.network}
    settings = [
        *(() if options.losses is None else LOSSES[options.losses]),
        *options.settings,
        *(f"{key}={value}" for key, value in named.items() if value is not None),
        *reader_settings(name=options.reader, topic=options.topic, sequence=options.sequence),
    ]
    return load_train_config(options.config_file or earlier, settings)


def _earlier_sources(earlier: Path | None) -> tuple[Path, ...]:
    """The recordings that a training was begun on."""
    section = {} if earlier is None else read_yaml(earlier).get(SOURCES_SECTION)
    sources = section.get("sources", []) if isinstance(section, dict) else []
    return tuple(Path(str(source)) for source in sources)
