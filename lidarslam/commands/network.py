"""`lidarslam train` and `lidarslam export`: weights of the learned odometry."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands import options as opt
from lidarslam.commands.terminal import EXIT_MENDABLE, say


@opt.command(
    """lidarslam train office.mcap street.mcap
    lidarslam train KITTI --sequence 00 -o trained --from shipped --steps 2000
    lidarslam train --set simulated.recordings=100
    lidarslam train -o trained --resume"""
)
@click.argument("sources", type=opt.PATH, nargs=-1, metavar="[SOURCE]...")
@opt.out_option("Directory of the training.", "trained/SOURCE_TIME, after the first")
@click.option("--resume", is_flag=True, help="Continue the training in DIR, on the same recordings.")
@click.option("--overwrite", is_flag=True, help="Replace the training in DIR.")
@click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", help="auto: a GPU where there is one."
)
@click.option("--steps", type=click.IntRange(min=1), help="Training steps.  [default: 12000]")
@click.option("--network", type=click.Choice(["correlation", "delora"]), help="What to train.  [default: correlation]")
@click.option(
    "--losses",
    type=click.Choice(["both", "point-to-plane", "plane-to-plane", "paper", "alignment"]),
    help="Losses: the geometric ones, in DeLORA's form (paper), or the distance to the aligned motion (alignment)."
    "  [default: both and alignment]",
)
@click.option("--from", "start_from", metavar="WEIGHTS", help="Initial weights; shipped: the included ones.")
@click.option(
    "--prepared", type=opt.PATH, metavar="DIR", help="Cache of preprocessed recordings.  [default: prepared in --out]"
)
@opt.jobs_options
@opt.reader_options
@opt.config_options
def train(sources: tuple[Path, ...], out: Path | None, **options: Any) -> int:
    """Train the learned odometry on recordings without labels.

    Ctrl-C ends the training with the weights so far, and --resume continues it. --jobs and --ray are for the
    preparation of recordings.
    """
    from lidarslam.odometry.registry import require_train_extra
    from lidarslam.storage.finished_run import source_name

    if out is None:
        if options["resume"]:
            raise click.UsageError("--resume continues the training in --out; name it")
        out = opt.default_out("trained", source_name(sources[0], options["sequence"]) if sources else "simulated")
    require_train_extra("training")
    where = opt.take_where(options)
    from lidarslam.train.train import run_train

    return 0 if run_train(sources, say, out=out, where=where, **options) else EXIT_MENDABLE


@opt.command("lidarslam export --weights trained/weights.safetensors -o exported")
@click.option("--weights", type=opt.PATH, metavar="FILE", help="Trained weights.  [default: included]")
@opt.out_option("Folder for the ONNX graphs.", "exported/WEIGHTS_TIME")
def export(weights: Path | None, out: Path | None) -> None:
    """Export a trained network as ONNX.

    `lidarslam run --weights DIR` starts faster with the folder than with the weights file, as it does not import torch.
    docs/odometry.md lists inputs and outputs of the graphs.
    """
    from lidarslam.odometry.registry import require_train_extra

    require_train_extra("an export")
    from lidarslam.odometry.network.checkpoint import export_onnx, load_checkpoint
    from lidarslam.odometry.registry import default_weights

    weights = weights or default_weights()
    checkpoint = load_checkpoint(weights)
    for path in export_onnx(checkpoint, out or opt.default_out("exported", weights.stem)):
        say(f"written to {path}")
