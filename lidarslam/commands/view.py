"""`lidarslam view`: finished runs in Rerun."""

import signal
from pathlib import Path

import click

from lidarslam.commands.options import PATH, CommandWithExample, config_options
from lidarslam.commands.terminal import say
from lidarslam.core.errors import InputError


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam view runs/04
    lidarslam view runs/04 runs/wheels --web
    lidarslam view runs/04 --picture map.png""",
)
@click.argument("runs", type=PATH, nargs=-1, required=True)
@click.option("--web", is_flag=True, help="Serve a browser on this machine instead of opening a window.")
@click.option("--save", type=PATH, metavar="FILE.rrd", help="Save a Rerun recording instead of opening a window.")
@click.option("--picture", type=PATH, metavar="FILE.png", help="Draw the map of one run, or a .ply file, instead.")
@config_options
def view(
    runs: tuple[Path, ...],
    web: bool,
    save: Path | None,
    picture: Path | None,
    config_file: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Show finished runs in Rerun: trajectories, maps, and where tracking was lost."""
    from lidarslam.config.settings import load_config
    from lidarslam.storage.finished_run import load_run

    if sum([web, save is not None, picture is not None]) > 1:
        raise click.UsageError("--web, --save and --picture exclude one another; choose one")
    if picture is not None:
        _draw_map(runs, picture)
        return
    if save is not None and save.suffix.lower() != ".rrd":
        raise InputError(f"{save}: a Rerun recording must end in .rrd; for a picture use --picture {save}")
    config = load_config(config_file, settings).viewer
    finished = [load_run(path) for path in runs]
    from lidarslam.viewer.rerun_runs import open_runs, save_runs, served_runs

    if save is not None:
        save_runs(finished, config, save)
        say(f"written to {save}")
    elif web:
        with served_runs(finished, config) as address:
            say(address)
            say("serving this machine until Ctrl-C; from another machine, forward ports 9090 and 9876 with ssh -L")
            signal.pause()
    else:
        open_runs(finished, config)


def _draw_map(runs: tuple[Path, ...], picture: Path) -> None:
    from lidarslam.storage.finished_run import load_map
    from lidarslam.viewer.picture import draw, height_colours, save_picture

    if len(runs) != 1:
        raise click.UsageError("--picture draws one map; name one run")
    cloud = load_map(runs[0])
    if not len(cloud):
        raise InputError(f"{runs[0]}: holds no map to draw")
    save_picture(picture, draw(cloud.points, height_colours(cloud.points), cloud.normals))
    say(f"written to {picture}")
