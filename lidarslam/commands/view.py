"""`lidarslam view`: finished runs, raw scans and Rerun recordings."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from lidarslam.commands import options as opt
from lidarslam.commands.terminal import note, say, serving, wait_for_interrupt
from lidarslam.core.errors import InputError

if TYPE_CHECKING:
    from lidarslam.viewer.rerun_program import WebPage

_RRD = ".rrd"


@opt.command(
    """lidarslam view
    lidarslam view runs/04 runs/wheels --web
    lidarslam view office.mcap --web
    lidarslam view compared/04 --web
    lidarslam view runs/04/recording.rrd
    lidarslam view runs/04 --picture map.png
    lidarslam view compared/04 --picture maps.png"""
)
@click.argument("places", type=opt.PATH, nargs=-1, metavar="[RUN... | SOURCE | FILE.rrd]")
@click.option("--web", is_flag=True, help="Serve a browser on this machine instead of opening a window.")
@click.option("--save", type=opt.PATH, metavar="FILE.rrd", help="Save a Rerun recording instead of opening a window.")
@click.option(
    "--picture",
    type=opt.PATH,
    metavar="FILE.png",
    help="Draw runs, or .ply files, in one picture instead; into a folder, each in one of its own, in the same frame.",
)
@click.option("--oblique", is_flag=True, help="Draw the picture obliquely instead of from above.")
@opt.scan_options
@opt.reader_options
@opt.config_options
@click.pass_context
def view(
    ctx: click.Context,
    /,
    places: tuple[Path, ...],
    web: bool,
    save: Path | None,
    picture: Path | None,
    oblique: bool,
    **options: Any,
) -> None:
    """Show runs, the scans of a recording, or a Rerun recording.

    RUN is a run directory, or the folder of a comparison for its runs; several are shown in one space, aligned with the
    ground truth if there is one.  [default: the latest run in runs]  SOURCE is a recording; --start, --stop and --step
    choose its scans. With --picture, RUN may also be a cloud (.ply or .pcd).
    """
    if web + (save is not None) + (picture is not None) > 1:
        raise click.UsageError("--web, --save and --picture exclude one another; choose one")
    if oblique and picture is None:
        raise click.UsageError("--oblique belongs to --picture")
    places = places or (opt.latest_run(),)
    if picture is not None:
        _draw(places, picture, oblique)
    elif any(place.suffix.lower() == _RRD for place in places):
        if len(places) > 1 or save is not None:
            raise click.UsageError(f"a {_RRD} file is shown alone, in a window or with --web")
        _replay(places[0], web)
    elif save is not None and save.suffix.lower() != _RRD:
        raise InputError(f"{save}: a Rerun recording must end in {_RRD}; for a picture use --picture {save}")
    else:
        _show(_to_show(ctx, places, options), web, save)


def _replay(file: Path, web: bool) -> None:
    from lidarslam.viewer.rerun_recording import show_file_in_window, show_file_on_page

    if web:
        _serve(lambda page: show_file_on_page(file, page))
    else:
        show_file_in_window(file)


def _show(show: Any, web: bool, file: Path | None) -> None:
    from lidarslam.viewer.rerun_recording import save, show_in_window, show_on_page

    if file is not None:
        save(show, file)
        say(f"written to {file}")
    elif web:
        _serve(lambda page: show_on_page(show, page))
    else:
        show_in_window(show)


def _serve(show: "Callable[[WebPage], None]") -> None:
    with contextlib.suppress(KeyboardInterrupt), serving() as page:  # Ctrl-C is its regular end
        show(page)
        wait_for_interrupt()


def _to_show(ctx: click.Context, places: tuple[Path, ...], options: dict[str, Any]) -> Any:
    """The scene that is shown; its type is not named because that would import Rerun."""
    from lidarslam.assessment.inputs import truth_of_run
    from lidarslam.config.settings import load_config
    from lidarslam.datasets.registry import is_recording
    from lidarslam.storage.finished_run import is_run, load_run, run_directories

    if len(places) == 1 and not is_run(places[0]) and is_recording(places[0], options["reader"]):
        return _scans(places[0], options)
    for name in ("start", "stop", "step", "reader", "topic", "sequence"):
        if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise click.UsageError(f"--{name} belongs to a recording, and {places[0]} is none")
    config = load_config(options["config_file"], options["settings"]).viewer
    runs = [run for place in places for run in run_directories(place)]
    finished = [load_run(path) for path in runs]
    from lidarslam.viewer.rerun_scenes import show_runs

    return show_runs(finished, truth_of_run(runs[0]), config)


def _scans(source: Path, options: dict[str, Any]) -> Any:
    from lidarslam.datasets.intake import choose_scans
    from lidarslam.datasets.registry import open_recording
    from lidarslam.run.progress import show_count
    from lidarslam.viewer.rerun_scenes import show_scans

    config = opt.take_config(options, source)
    recording = open_recording(source, config.reader)
    chosen = choose_scans(recording, source, options["start"], options["stop"], options["step"])
    return show_scans(recording, source, chosen, config.viewer, show_count, note)


def _draw(places: tuple[Path, ...], picture: Path, oblique: bool) -> None:
    from lidarslam.viewer.picture import OBLIQUE, TOP, draw_apart, draw_runs, fit_frame, load_drawn_runs, save_picture

    runs = load_drawn_runs(places)
    frame = fit_frame(runs, OBLIQUE if oblique else TOP)
    if picture.suffix:
        save_picture(picture, draw_runs(runs, frame))
        say(f"written to {picture}")
    else:
        say(f"written to {', '.join(map(str, draw_apart(runs, picture, frame)))}")
