"""`lidarslam view`: finished runs, recordings and Rerun recordings in Rerun."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from lidarslam.commands.options import (
    PATH,
    CommandWithExample,
    config_options,
    reader_options,
    scan_options,
    take_config,
)
from lidarslam.commands.serving import serving, wait_for_interrupt
from lidarslam.commands.terminal import note, say
from lidarslam.core.errors import InputError

if TYPE_CHECKING:
    from lidarslam.core.scan import Scan
    from lidarslam.datasets.recording import Recording
    from lidarslam.viewer.rerun_output import Show
    from lidarslam.viewer.web_page import WebPage

_RRD = ".rrd"


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam view runs/04
    lidarslam view runs/04 runs/wheels --web
    lidarslam view office.mcap --web
    lidarslam view runs/04/recording.rrd
    lidarslam view runs/04 --picture map.png""",
)
@click.argument("places", type=PATH, nargs=-1, required=True, metavar="RUN... | SOURCE | FILE.rrd")
@click.option("--web", is_flag=True, help="Serve a browser on this machine instead of opening a window.")
@click.option("--save", type=PATH, metavar="FILE.rrd", help="Save a Rerun recording instead of opening a window.")
@click.option("--picture", type=PATH, metavar="FILE.png", help="Draw the map of one run, or a .ply file, instead.")
@scan_options
@reader_options
@config_options
@click.pass_context
def view(
    ctx: click.Context, /, places: tuple[Path, ...], web: bool, save: Path | None, picture: Path | None, **options: Any
) -> None:
    """Show finished runs, the raw scans of a recording, or a Rerun recording, in Rerun.

    Several runs appear in one space, aligned with the ground truth if there is one. --start, --stop and --step choose
    the scans of a recording.
    """
    if sum([web, save is not None, picture is not None]) > 1:
        raise click.UsageError("--web, --save and --picture exclude one another; choose one")
    if picture is not None:
        _draw_map(places, picture)
    elif any(place.suffix == _RRD for place in places):
        if len(places) > 1 or save is not None:
            raise click.UsageError(f"a {_RRD} file is shown alone, in a window or with --web")
        _replay(places[0], web)
    else:
        _show(_to_show(ctx, places, options), web, save)


def _replay(file: Path, web: bool) -> None:
    from lidarslam.viewer.rerun_output import show_file_in_window, show_file_on_page

    if web:
        _serve(lambda page: show_file_on_page(file, page))
    else:
        show_file_in_window(file)


def _show(show: "Show", web: bool, file: Path | None) -> None:
    from lidarslam.viewer.rerun_output import save, show_in_window, show_on_page

    if file is not None:
        save(show, file)
        say(f"written to {file}")
    elif web:
        _serve(lambda page: show_on_page(show, page))
    else:
        show_in_window(show)


def _serve(show: "Callable[[WebPage], None]") -> None:
    with contextlib.suppress(KeyboardInterrupt), serving() as page:  # Ctrl-C is how it ends well
        show(page)
        wait_for_interrupt()


def _to_show(ctx: click.Context, places: tuple[Path, ...], options: dict[str, Any]) -> "Show":
    from lidarslam.config.settings import load_config
    from lidarslam.datasets.registry import is_recording
    from lidarslam.evaluate.inputs import truth_of_run
    from lidarslam.storage.finished_run import is_run, load_run

    if len(places) == 1 and not is_run(places[0]) and is_recording(places[0], options["reader"]):
        return _scans(places[0], options)
    for name in ("start", "stop", "step", "reader", "topic", "sequence"):
        if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise click.UsageError(f"--{name} belongs to a recording, and {places[0]} is none")
    config = load_config(options["config_file"], options["settings"]).viewer
    finished = [load_run(path) for path in places]
    from lidarslam.viewer.rerun_runs import show_runs

    return show_runs(finished, truth_of_run(places[0]), config)


def _scans(source: Path, options: dict[str, Any]) -> "Show":
    from lidarslam.datasets.intake import choose_scans
    from lidarslam.datasets.registry import open_recording
    from lidarslam.viewer.rerun_scans import show_scans

    config = take_config(options, source)
    recording = open_recording(source, config.reader)
    chosen = choose_scans(recording, source, options["start"], options["stop"], options["step"])
    return show_scans(source.name, _read(recording, source, chosen), recording.ground_truth, config.viewer)


def _read(recording: "Recording", source: Path, chosen: range) -> "Iterator[Scan]":
    """The scans, with a progress bar and notes on what is wrong with them."""
    from lidarslam.datasets.faults import Faults
    from lidarslam.datasets.intake import take_in
    from lidarslam.run.progress import show_count

    faults, number = Faults(), 0
    with show_count(source.name) as count:
        for number, scan in enumerate(take_in(recording, chosen, faults), start=1):
            yield scan
            count(number, len(chosen))
    for warning in (*recording.warnings, *faults.warnings()):
        note(warning)
    if not number:
        raise InputError(f"{source}: no scan can be read")


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
