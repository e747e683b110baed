"""The options `--max` and `--min`: bounds of figures."""

from collections.abc import Callable
from typing import Any

import click


class _Gate(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """A bound of a figure; of a comparison, of one method too."""

    name = "gate"

    def __init__(self, with_method: bool) -> None:
        self._with_method = with_method

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The gate, named by the parameter: of `--max` or of `--min`."""
        from lidarslam.core.errors import ConfigError
        from lidarslam.evaluation.comparison.gates import parse_gate

        try:
            return parse_gate(
                "max" if param is not None and param.name == "maxima" else "min", value, self._with_method
            )
        except ConfigError as error:
            self.fail(str(error), param, ctx)


def gate_options(with_method: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The options; their values are `maxima` and `minima`."""

    def option(flag: str, name: str, text: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        form = f"{'[METHOD:]' if with_method else ''}NAME=VALUE"
        return click.option(flag, name, type=_Gate(with_method), multiple=True, metavar=form, help=text)

    highest = option("--max", "maxima", "Upper bound of a figure, such as ate=0.1; may be repeated.")
    lowest = option("--min", "minima", "Lower bound of a figure, such as f_score_0.1=90; may be repeated.")
    return lambda function: highest(lowest(function))
