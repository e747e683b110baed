"""`lidarslam info`: what a recording holds."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import SOURCE, CommandWithExample, config_options, reader_options, take_config
from lidarslam.commands.terminal import say


@click.command(cls=CommandWithExample, epilog="lidarslam info recordings/2011_09_26_drive_0005_sync")
@SOURCE
@reader_options
@config_options
def info(source: Path, **options: Any) -> None:
    """Say what a recording holds, and what was inferred about it."""
    from lidarslam.datasets.info_text import describe_source

    config = take_config(options, options.pop("settings"), source)
    say(describe_source(source, config.reader))
