"""Numbers as tables show them."""

import math

DASH = "–"
"""Stands for what could not be computed."""

_TOO_LONG = 1e6


def number_text(value: float | str | None, digits: int) -> str:
    """The number with so many decimals; a dash for None and what is not finite, text as it is."""
    if isinstance(value, str):
        return value
    if value is None or not math.isfinite(value):
        return DASH
    if abs(value) >= _TOO_LONG:
        return f"{value:.2e}".replace("-", "\N{MINUS SIGN}")
    text = f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text.lstrip("-")
