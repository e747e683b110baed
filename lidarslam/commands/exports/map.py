"""`lidarslam map`: maps joined, cleaned, levelled and cropped."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands.shared.options import FILE, PATH, POSITIVE, CommandWithExample
from lidarslam.commands.shared.terminal import say

_COUNT = click.IntRange(min=1)


@click.command(
    "map",
    cls=CommandWithExample,
    epilog="""lidarslam map runs/office -o office.ply --level ground --ground-at-zero
    lidarslam map runs/office -o slice.pcd --box -10 10 -5 5 0.2 1.8 --within 8
    lidarslam map runs/street -o clean.laz --moved 2 --statistical 20 2.5
    lidarslam map runs/hall annex.ply -o site.ply --register""",
)
@click.argument("sources", type=PATH, nargs=-1, required=True, metavar="SOURCE...")
@click.option("-o", "--out", type=PATH, required=True, metavar="FILE", help=".ply, .pcd, .laz or .e57 file.")
@click.option(
    "--moved",
    type=click.IntRange(min=0),
    metavar="N",
    help="Draw the map again from the recording, without what N range images saw through (a run: 3); 0 keeps all.",
)
@click.option(
    "--transform",
    "transforms",
    type=FILE,
    multiple=True,
    help="Text file with the 4x4 pose of a further source in the frame of the first; one for each, in their order.",
)
@click.option("--register", is_flag=True, help="Register further sources to the first.")
@click.option(
    "--statistical",
    type=(_COUNT, POSITIVE),
    metavar="N SIGMAS",
    help="Remove points whose mean distance to N neighbours is SIGMAS standard deviations above the average.",
)
@click.option(
    "--radius",
    type=(_COUNT, POSITIVE),
    metavar="N M",
    help="Remove points with fewer than N neighbours within M metres.",
)
@click.option("--level", type=click.Choice(["ground", "gravity"]), help="Turn the ground's normal, or up, to z.")
@click.option("--ground-at-zero", is_flag=True, help="Shift the ground below the origin to z = 0.")
@click.option("--box", type=float, nargs=6, metavar="X X Y Y Z Z", help="Keep a box, from and to, m; once levelled.")
@click.option("--within", "within_m", type=POSITIVE, metavar="M", help="Keep what is within M metres of the path.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier file.")
def edit(sources: tuple[Path, ...], out: Path, overwrite: bool, **options: Any) -> None:
    """Join, clean, level and crop maps.

    SOURCE is a run directory, or a .ply or .pcd cloud; several are in one frame unless --transform or --register says
    where they lie. The edits are made in the order of the options here.
    """
    from lidarslam.exports.map import SUFFIXES, MapEdits, edit_map
    from lidarslam.exports.new_file import require_new
    from lidarslam.mapping.global_map.point_cloud import require_format

    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"--out {out}: expected a file {', '.join(SUFFIXES)}")
    if options["transforms"] and len(options["transforms"]) != len(sources) - 1:
        raise click.UsageError(f"expected a --transform for each of the {len(sources) - 1} further sources")
    box = options["box"]
    if box is not None and not all(low < high for low, high in zip(box[::2], box[1::2], strict=True)):
        raise click.UsageError(f"--box {' '.join(f'{side:g}' for side in box)}: expected each from less than its to")
    if out.suffix == ".e57":
        require_format("e57")
    require_new(out, overwrite)
    for line in edit_map(sources, out, MapEdits(**options)):
        say(line)
