"""`lidarslam datasets`: published data sets."""

import click

from lidarslam.commands.shared.options import CommandWithExample
from lidarslam.commands.shared.terminal import say


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam datasets
    lidarslam datasets hilti_2022
    lidarslam datasets /data --json""",
)
@click.argument("arguments", nargs=-1, metavar="[NAME | FOLDER]...")
@click.option("--json", "as_json", is_flag=True, help="Print JSON; docs/data_sets.md describes the keys.")
def datasets(arguments: tuple[str, ...], as_json: bool) -> None:
    """List published data sets and those on disk, or describe one."""
    from lidarslam.commands.shared import catalogue_text as text

    chosen, folders = text.choose(arguments)
    on_disk = text.find_on_disk(folders)
    if as_json:
        say(text.as_json(chosen, on_disk))
    elif chosen:
        say("\n\n".join(text.describe_data_set(one, on_disk) for one in chosen))
    else:
        say(text.list_data_sets(on_disk))
