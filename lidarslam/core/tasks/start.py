"""Start of what carries out tasks; Ray is loaded only where it is needed."""

from contextlib import AbstractContextManager, nullcontext

from lidarslam.core.errors import ConfigError
from lidarslam.core.tasks.tasks import InOrder, Tasks, Where


def open_tasks(where: Where) -> AbstractContextManager[Tasks]:
    """What carries out tasks there, for the time of the context.

    Raises:
        ConfigError: Ray is not installed, or no cluster has that address.
    """
    if where.is_serial:
        return nullcontext(InOrder())
    try:
        from lidarslam.core.tasks.on_ray import ray_tasks
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{error.name} is not installed, which --jobs and --ray need; pip install 'lidarslam[ray]'"
        ) from error
    return ray_tasks(where)
