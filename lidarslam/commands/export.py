"""`lidarslam export`: a trained network for other programs."""

from pathlib import Path

import click

from lidarslam.commands.options import PATH, CommandWithExample
from lidarslam.commands.terminal import say


@click.command(cls=CommandWithExample, epilog="lidarslam export --weights trained/weights.safetensors --out exported")
@click.option("--weights", type=PATH, metavar="FILE", help="Trained weights.  [default: those of the program]")
@click.option("--out", type=PATH, required=True, metavar="DIR", help="Folder that encoder.onnx and pair.onnx go to.")
def export(weights: Path | None, out: Path) -> None:
    """Write a trained network as ONNX, for other programs.

    encoder.onnx takes the points and normals of scans as images; pair.onnx takes what it gives for two of them.
    """
    from odometry.checkpoint import default_weights, load_checkpoint
    from odometry.export import export_onnx

    for path in export_onnx(load_checkpoint(weights or default_weights()), out):
        say(f"written to {path}")
