"""`lidarslam info`: the contents of a recording."""

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
    """Print what a recording holds, and what was inferred about it."""
    from lidarslam.datasets.info_text import describe_source

    say(describe_source(source, take_config(options, source).reader))
