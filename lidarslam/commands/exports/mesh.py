"""`lidarslam export-mesh`: the map of a run as a surface."""

from pathlib import Path

import click

from lidarslam.commands.shared.options import PATH, POSITIVE, CommandWithExample
from lidarslam.commands.shared.terminal import say


@click.command("export-mesh", cls=CommandWithExample, epilog="lidarslam export-mesh runs/office -o office.glb")
@click.argument("run", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, metavar="FILE", help=".ply, .obj, .glb or .stl file.")
@click.option(
    "--cell", "cell_m", type=POSITIVE, help="Edge of the smallest cells, m.  [default: two voxels of the map]"
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier file.")
def export_mesh(run: Path, out: Path, cell_m: float | None, overwrite: bool) -> None:
    """Write the map as a triangle mesh.

    RUN is a run directory. Poisson reconstruction, without the surface where the map has no points.
    """
    from lidarslam.exports.mesh import SUFFIXES, export_mesh
    from lidarslam.exports.new_file import require_new

    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"--out {out}: expected a file {', '.join(SUFFIXES)}")
    require_new(out, overwrite)
    for line in export_mesh(run, out, cell_m):
        say(line)
