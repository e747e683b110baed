"""`lidarslam view`: finished runs in Rerun."""

import signal
from pathlib import Path

import click

from lidarslam.commands.options import PATH, CommandWithExample, config_options, latest_run
from lidarslam.commands.terminal import say


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam view
    lidarslam view runs/04 runs/wheels --web
    lidarslam view runs/04 --picture map.png
    lidarslam view compared/04 --picture maps.png""",
)
@click.argument("runs", type=PATH, nargs=-1, metavar="[RUN]...")
@click.option("--web", is_flag=True, help="Serve a browser on this machine instead of opening a window.")
@click.option("--save", type=PATH, metavar="FILE.rrd", help="Save a Rerun recording instead of opening a window.")
@click.option("--picture", type=PATH, metavar="FILE.png", help="Draw runs, or .ply files, in one picture instead.")
@click.option("--oblique", is_flag=True, help="Draw the picture obliquely instead of from above.")
@config_options
def view(
    runs: tuple[Path, ...],
    web: bool,
    save: Path | None,
    picture: Path | None,
    oblique: bool,
    config_file: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Show finished runs: trajectories, maps, and where tracking was lost.

    RUN is a run directory.  [default: the latest run in runs]  With --picture, it may also be the folder of a
    comparison, or a cloud (.ply or .pcd).
    """
    from lidarslam.config.settings import load_config
    from lidarslam.storage.finished_run import load_run

    if sum([web, save is not None, picture is not None]) > 1:
        raise click.UsageError("--web, --save and --picture exclude one another; choose one")
    runs = runs or (latest_run(),)
    if picture is not None:
        _draw(runs, picture, oblique)
        return
    if save is not None and save.suffix.lower() != ".rrd":
        raise click.UsageError(f"{save}: a Rerun recording must end in .rrd; for a picture use --picture {save}")
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


def _draw(runs: tuple[Path, ...], picture: Path, oblique: bool) -> None:
    from lidarslam.viewer.drawn_runs import load_drawn_runs
    from lidarslam.viewer.picture import OBLIQUE, TOP, draw_runs, save_picture

    save_picture(picture, draw_runs(load_drawn_runs(runs), OBLIQUE if oblique else TOP).pixels)
    say(f"written to {picture}")
