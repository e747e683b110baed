"""`lidarslam export`: a trained network as ONNX."""

from pathlib import Path

import click

from lidarslam.commands.options import PATH, CommandWithExample
from lidarslam.commands.terminal import say


@click.command(cls=CommandWithExample, epilog="lidarslam export --weights trained/weights.safetensors --out exported")
@click.option("--weights", type=PATH, metavar="FILE", help="Trained weights.  [default: included]")
@click.option("--out", type=PATH, required=True, metavar="DIR", help="Folder for the ONNX graphs.")
def export(weights: Path | None, out: Path) -> None:
    """Export a trained network as ONNX.

    `lidarslam run --weights DIR` starts faster with the folder than with the weights file, as it does not import torch.
    docs/odometry.md lists inputs and outputs of the graphs.
    """
    from lidarslam.odometry.train_extra import require_train_extra

    require_train_extra("an export")
    from lidarslam.odometry.network.checkpoint import load_checkpoint
    from lidarslam.odometry.network.export import export_onnx
    from lidarslam.odometry.network.shipped import default_weights

    for path in export_onnx(load_checkpoint(weights or default_weights()), out):
        say(f"written to {path}")
