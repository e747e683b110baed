"""`lidarslam evaluate`: errors of a trajectory and its map."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import PATH, CommandWithExample
from lidarslam.commands.terminal import say


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam evaluate runs/04
    lidarslam evaluate runs/site --reference-map survey.laz --errors errors.ply
    lidarslam evaluate kitti_00.txt --reference poses/00.txt""",
)
@click.argument("run", type=PATH)
@click.option(
    "--reference",
    type=PATH,
    metavar="TRAJ",
    help="TUM or KITTI file, run directory, or recording with ground truth.  [default: what came with the source]",
)
@click.option("--no-reference", is_flag=True, help="Without any reference: the entropy of the map only.")
@click.option(
    "--alignment",
    type=click.Choice(["se3", "first_pose", "none"]),
    default="se3",
    show_default=True,
    help="How the trajectory is brought to the reference for the ATE.",
)
@click.option("--tolerance-s", type=click.FloatRange(min=0.0), help="Poses this close in time match.  [default: 0.02]")
@click.option(
    "--max-gap-s", type=click.FloatRange(min=0.0), help="Gaps in the reference that are bridged.  [default: 0.5]"
)
@click.option(
    "--reference-map",
    type=PATH,
    metavar="MAP",
    help=".ply, .pcd, .las, .laz or .e57 file.  [default: the exact map of a simulated source]",
)
@click.option("--map", "map_file", type=PATH, metavar="FILE", help="Map of a bare trajectory, or instead of the run's.")
@click.option(
    "--map-alignment",
    metavar="[auto|trajectory|global|none|FILE]",
    default="auto",
    show_default=True,
    help="How the map is brought to the reference map: by the trajectories, by a global search, not at all, or by a"
    " text file with the 4x4 matrix from the map to the reference.",
)
@click.option(
    "--refine/--no-refine", default=None, help="Improve that by ICP.  [default: refine, unless the alignment is none]"
)
@click.option(
    "--spacing",
    "spacing_m",
    type=click.FloatRange(min=0.0, min_open=True),
    help="Both maps are thinned to one point in cells of this size, metres.  [default: 0.05]",
)
@click.option(
    "--max-range",
    "max_range_m",
    type=click.FloatRange(min=0.0, min_open=True),
    help="What is farther from the path does not count as missing, metres.  [default: the reach of the run's map]",
)
@click.option(
    "--errors", type=PATH, multiple=True, metavar="FILE", help="Write the map coloured by its errors, .ply or .rrd."
)
@click.option(
    "--errors-clip",
    "errors_clip_m",
    type=click.FloatRange(min=0.0, min_open=True),
    default=0.5,
    show_default=True,
    help="Error of the brightest colour, metres.",
)
@click.option("--out", type=PATH, metavar="FILE", help="Write the figures there.  [default: metrics.json of the run]")
def evaluate(run: Path, **options: Any) -> None:
    """Errors of a trajectory and its map.

    RUN is a run directory, or a trajectory in TUM or KITTI text.
    """
    from lidarslam.evaluate.evaluate import EvaluateRequest, evaluate
    from lidarslam.evaluate.map_evaluation import MapOptions
    from lidarslam.evaluate.text import format_evaluation

    given = {name: value for name, value in options.items() if value is not None}
    if given.get("reference") and given["no_reference"]:
        raise click.UsageError("--reference and --no-reference exclude each other; choose one")
    named = {"map_alignment": "alignment", "refine": "refine", "spacing_m": "spacing_m", "max_range_m": "max_range_m"}
    map_options = MapOptions(**{named[name]: given.pop(name) for name in named if name in given})
    request = EvaluateRequest(run, needs_reference=not given.pop("no_reference"), map_options=map_options, **given)
    say(format_evaluation(evaluate(request)))
