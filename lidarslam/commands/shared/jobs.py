"""The options `--jobs` and `--ray` of the commands whose parts are independent of one another."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from lidarslam.core.tasks import Where


def jobs_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options, as a decorator."""
    jobs = click.option(
        "--jobs",
        type=click.IntRange(min=1),
        default=1,
        show_default=True,
        metavar="N",
        help="Compute in N processes; needs the extra ray.",
    )
    cluster = click.option("--ray", metavar="ADDRESS", help="Compute on a Ray cluster: auto, or HOST:6379 of its head.")
    return jobs(cluster(function))


def take_where(options: dict[str, Any]) -> "Where":
    """Where independent tasks are carried out; the options it is made of are removed.

    Raises:
        UsageError: the options exclude each other.
    """
    from lidarslam.core.tasks import Where

    jobs, cluster = options.pop("jobs"), options.pop("ray")
    if cluster is not None and jobs > 1:
        raise click.UsageError("--jobs is of this machine; a cluster computes as many tasks at once as it has CPUs")
    return Where(jobs, cluster)
