"""`lidarslam export`: a trained network as ONNX."""

from pathlib import Path

import click

from lidarslam.commands.options import PATH, CommandWithExample
from lidarslam.commands.terminal import say


@click.command(cls=CommandWithExample, epilog="lidarslam export --weights trained/weights.safetensors --out exported")
@click.option("--weights", type=PATH, metavar="FILE", help="Trained weights.  [default: those of the program]")
@click.option("--out", type=PATH, required=True, metavar="DIR", help="Folder that the ONNX graphs go to.")
def export(weights: Path | None, out: Path) -> None:
    """Write a trained network as ONNX.

    `lidarslam run --weights DIR` starts faster with the folder than with the file of weights, because it does without
    torch. Other programs can run the graphs; docs/odometry.md lists their inputs and outputs.
    """
    from odometry.network.checkpoint import load_checkpoint
    from odometry.network.export import export_onnx
    from odometry.network.shipped import default_weights

    for path in export_onnx(load_checkpoint(weights or default_weights()), out):
        say(f"written to {path}")
