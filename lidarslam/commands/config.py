"""`lidarslam config`: the resolved configuration, and those that come with the program."""

from collections.abc import Iterator
from pathlib import Path

import click

from lidarslam.commands import options as opt
from lidarslam.commands.terminal import say
from lidarslam.core.text import printable


@opt.command(
    """lidarslam config --list
    lidarslam config -c indoor --set odometry.kiss_icp.voxel_size_m=0.5"""
)
@click.option("--list", "listing", is_flag=True, help="List the configurations and benchmarks that come along.")
@opt.config_options
def config(listing: bool, config_file: Path | None, settings: tuple[str, ...]) -> None:
    """Print the resolved configuration as YAML."""
    from lidarslam.config.settings import dump_yaml, load_config

    if listing:
        say("\n".join(_shipped()))
        return
    click.echo(printable(dump_yaml(load_config(config_file, settings))), nl=False)


def _shipped() -> Iterator[str]:
    from lidarslam.config.settings import BENCHMARKS, CONFIGS, headline, shipped_files
    from lidarslam.config.yaml_text import read_yaml

    kinds = {"--config NAME": shipped_files(CONFIGS), "compare --benchmark NAME": shipped_files(BENCHMARKS)}
    width = max(len(name) for files in kinds.values() for name in files) + 2
    for kind, files in kinds.items():
        yield kind
        for name, path in files.items():
            yield f"  {name:<{width}}{headline(path)}"
            if data := read_yaml(path).get("data"):
                yield f"  {'':<{width}}--data: {data}"
    yield f"The files are in {CONFIGS}"
