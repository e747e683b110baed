"""What stands between the options of `lidarslam train` and the training."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from lidarslam.config.settings import read_yaml, reader_settings
from lidarslam.core.errors import ConfigError
from lidarslam.train.config import TrainConfig, load_train_config, loss_settings
from lidarslam.train.directory import CONFIG, SOURCES_SECTION, is_training
from lidarslam.train.request import DeviceName, TrainOutcome, TrainRequest
from lidarslam.train.text import ConsoleNarrator, format_outcome
from lidarslam.train.train import execute
from odometry.network.shipped import default_weights

SHIPPED = "shipped"


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


def run_train(options: TrainOptions, say: Callable[[str], None]) -> TrainOutcome:
    """Train, and say how it goes and what came of it."""
    with closing(ConsoleNarrator(say)) as narrator:
        outcome = execute(request_of(options), narrator)
    if outcome.is_first:
        say(format_outcome(options.out, outcome))
    return outcome


def request_of(options: TrainOptions) -> TrainRequest:
    """What the options ask for; a training that is gone on with is as it was, but for what is given anew.

    Raises:
        ConfigError: options contradict each other, or a value does not fit.
    """
    if options.resume and options.overwrite:
        raise ConfigError("--resume goes on with what --overwrite replaces; choose one")
    if options.resume and options.start_from is not None:
        raise ConfigError("--resume goes on with the weights it left; leave --from out")
    earlier = options.out / CONFIG if options.resume and is_training(options.out) else None
    return TrainRequest(
        sources=options.sources or _earlier_sources(earlier),
        out=options.out,
        config=_config(options, earlier),
        start_from=_start(options.start_from),
        device=options.device,
        prepared=options.prepared,
        resume=options.resume,
        overwrite=options.overwrite,
    )


def _config(options: TrainOptions, earlier: Path | None) -> TrainConfig:
    named = {"training.steps": options.steps, "training.network.name": options.network}
    settings = [
        *options.settings,
        *(f"{key}={value}" for key, value in named.items() if value is not None),
        *loss_settings(options.losses),
        *reader_settings(name=options.reader, topic=options.topic, sequence=options.sequence),
    ]
    return load_train_config(options.config_file or earlier, settings)


def _earlier_sources(earlier: Path | None) -> tuple[Path, ...]:
    """What a training was begun on."""
    section = {} if earlier is None else read_yaml(earlier).get(SOURCES_SECTION)
    sources = section.get("sources", []) if isinstance(section, dict) else []
    return tuple(Path(str(source)) for source in sources)


def _start(name: str | None) -> Path | None:
    if name is None:
        return None
    return default_weights() if name == SHIPPED else Path(name)
