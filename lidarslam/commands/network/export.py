"""`lidarslam export`: a trained network as ONNX."""

from pathlib import Path

import click

from lidarslam.commands.shared.options import PATH, CommandWithExample, default_out, out_option
from lidarslam.commands.shared.terminal import say


@click.command(cls=CommandWithExample, epilog="lidarslam export --weights trained/weights.safetensors -o exported")
@click.option("--weights", type=PATH, metavar="FILE", help="Trained weights.  [default: included]")
@out_option("Folder for the ONNX graphs.", "exported/WEIGHTS_TIME")
def export(weights: Path | None, out: Path | None) -> None:
    """Export a trained network as ONNX.

    `lidarslam run --weights DIR` starts faster with the folder than with the weights file, as it does not import torch.
    docs/odometry.md lists inputs and outputs of the graphs.
    """
    from lidarslam.odometry.network.shipped import require_train_extra

    require_train_extra("an export")
    from lidarslam.odometry.network.checkpoint import load_checkpoint
    from lidarslam.odometry.network.export import export_onnx
    from lidarslam.odometry.network.shipped import default_weights

    weights = weights or default_weights()
    checkpoint = load_checkpoint(weights)
    for path in export_onnx(checkpoint, out or default_out("exported", weights.stem)):
        say(f"written to {path}")
