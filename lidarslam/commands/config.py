"""`lidarslam config`: the resolved configuration."""

from pathlib import Path

import click

from lidarslam.commands.options import CommandWithExample, config_options
from lidarslam.core.plain_text import printable


@click.command(cls=CommandWithExample, epilog="lidarslam config --set odometry.kiss_icp.voxel_size_m=0.5")
@config_options
def config(config_file: Path | None, settings: tuple[str, ...]) -> None:
    """Print the resolved configuration as YAML."""
    from lidarslam.config.settings import dump_yaml, load_config

    click.echo(printable(dump_yaml(load_config(config_file, settings))), nl=False)
