"""`lidarslam info`: the contents of a recording."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands.shared.options import SOURCE, CommandWithExample, config_options, reader_options, take_config
from lidarslam.commands.shared.terminal import say


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam info recordings/2011_09_26_drive_0005_sync
    lidarslam info office.mcap --json""",
)
@SOURCE
@click.option("--json", "as_json", is_flag=True, help="Print JSON; docs/command_line.md describes the keys.")
@reader_options
@config_options
def info(source: Path, as_json: bool, **options: Any) -> None:
    """Print what a recording holds, and what was inferred about it."""
    from lidarslam.datasets.info_text import describe_as_json, describe_source

    config = take_config(options, source).reader
    say((describe_as_json if as_json else describe_source)(source, config))
