"""`lidarslam info`: what a recording holds."""

from pathlib import Path

import click

from lidarslam.commands.options import (
    SOURCE,
    CommandWithExample,
    config_options,
    reader_options,
    resolve,
    warn_of_ignored,
)
from lidarslam.commands.terminal import say


@click.command(cls=CommandWithExample, epilog="lidarslam info recordings/2011_09_26_drive_0005_sync")
@SOURCE
@reader_options
@config_options
def info(
    source: Path,
    reader: str | None,
    topic: str | None,
    sequence: str | None,
    config_file: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Say what a recording holds, and what was inferred about it."""
    from lidarslam.info import describe_source

    config = resolve(config_file, settings, name=reader, topic=topic, sequence=sequence)
    warn_of_ignored(source, config.reader.name, topic, sequence)
    say(describe_source(source, config.reader))
