"""`lidarslam train`: weights of the learned odometry."""

import os
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.shared.jobs import jobs_options, take_where
from lidarslam.commands.shared.options import (
    PATH,
    CommandWithExample,
    config_options,
    default_out,
    out_option,
    reader_options,
)
from lidarslam.commands.shared.terminal import EXIT_MENDABLE, say


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam train office.mcap street.mcap
    lidarslam train KITTI --sequence 00 -o trained --from shipped --steps 2000
    lidarslam train --set simulated.recordings=100
    lidarslam train -o trained --resume""",
)
@click.argument("sources", type=PATH, nargs=-1, metavar="[SOURCE]...")
@out_option("Directory of the training.", "trained/SOURCE_TIME, after the first")
@click.option("--resume", is_flag=True, help="Continue the training in DIR, on the same recordings.")
@click.option("--overwrite", is_flag=True, help="Replace the training in DIR.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="auto: a GPU where there is one.",
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
    "--prepared", type=PATH, metavar="DIR", help="Cache of preprocessed recordings.  [default: prepared in --out]"
)
@jobs_options
@reader_options
@config_options
@click.pass_context
def train(ctx: click.Context, /, sources: tuple[Path, ...], out: Path | None, **options: Any) -> None:
    """Train the network of the learned odometry, self-supervised: recordings need no labels.

    Ctrl-C ends the training with the weights so far, and --resume continues it. Several GPUs: start it with torchrun;
    --jobs and --ray are for the preparation of recordings.
    """
    from lidarslam.odometry.network.shipped import require_train_extra
    from lidarslam.storage.default_places import source_name

    if out is None:
        if options["resume"]:
            raise click.UsageError("--resume continues the training in --out; name it")
        if "WORLD_SIZE" in os.environ:
            raise click.UsageError("the processes of torchrun share a directory; name it with --out")
        out = default_out("trained", source_name(sources[0], options["sequence"]) if sources else "simulated")
    require_train_extra("training")
    where = take_where(options)
    from lidarslam.train.train import run_train

    if not run_train(sources, say, out=out, where=where, **options):
        ctx.exit(EXIT_MENDABLE)
