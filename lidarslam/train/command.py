"""From the options of `lidarslam train` to the training."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lidarslam.config.settings import SOURCES_SECTION, reader_settings
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError
from lidarslam.odometry.network.shipped import default_weights
from lidarslam.train.directory import CONFIG, is_training
from lidarslam.train.settings import LOSSES, load_train_config
from lidarslam.train.train import TrainRequest, execute


def run_train(sources: tuple[Path, ...], say: Callable[[str], None], **options: Any) -> bool:
    """Train with the options of `lidarslam train --help`; whether all steps were done.

    A training that is resumed is as it was, but for what is given anew.

    Raises:
        LidarSlamError: options contradict each other, a value does not fit, or as `execute`.
    """
    out, start_from = options["out"], options["start_from"]
    if options["resume"] and options["overwrite"]:
        raise ConfigError("--resume goes on with what --overwrite replaces; choose one")
    if options["resume"] and start_from is not None:
        raise ConfigError("--resume goes on with the weights it left; leave --from out")
    earlier = out / CONFIG if options["resume"] and is_training(out) else None
    if start_from is not None:
        start_from = default_weights() if start_from == "shipped" else Path(start_from)
    named = {"training.steps": options["steps"], "training.network.name": options["network"]}
    settings = [
        *(() if options["losses"] is None else LOSSES[options["losses"]]),
        *options["settings"],
        *(f"{key}={value}" for key, value in named.items() if value is not None),
        *reader_settings(name=options["reader"], topic=options["topic"], sequence=options["sequence"]),
    ]
    request = TrainRequest(
        sources=sources or _earlier_sources(earlier),
        out=out,
        config=load_train_config(options["config_file"] or earlier, settings),
        start_from=start_from,
        **{name: options[name] for name in ("device", "prepared", "resume", "overwrite", "where")},
    )
    return execute(request, say)


def _earlier_sources(earlier: Path | None) -> tuple[Path, ...]:
    """The recordings that a training was begun on."""
    section = {} if earlier is None else read_yaml(earlier).get(SOURCES_SECTION)
    sources = section.get("sources", []) if isinstance(section, dict) else []
    return tuple(Path(str(source)) for source in sources)
