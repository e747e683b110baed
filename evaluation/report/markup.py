"""HTML and SVG as text, escaped by type: only `Markup` goes into a document, and only `escape` makes it of a `str`.

What is written here is well-formed XML and HTML at once.
"""

import html
import re
from collections.abc import Iterable
from typing import NewType

Markup = NewType("Markup", str)

# What XML cannot hold in any spelling, lone surrogates included, which no file could be written with either.
_UNSPEAKABLE = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

NOTHING = Markup("")


def escape(text: str) -> Markup:
    """The text for a document's content or a quoted attribute; what XML cannot hold becomes U+FFFD."""
    return Markup(html.escape(_UNSPEAKABLE.sub("\ufffd", text), quote=True))


def element(name: str, *children: Markup, **attributes: str | float | None) -> Markup:
    """An element; attributes that are None are left out.

    Underscores in attributes stand for hyphens, a trailing one is dropped (`class_`). Numbers get two decimals.
    """
    given = "".join(
        f' {_attribute_name(key)}="{_attribute_value(value)}"' for key, value in attributes.items() if value is not None
    )
    return Markup(f"<{name}{given}>{''.join(children)}</{name}>")


def join(parts: Iterable[Markup], separator: str = "") -> Markup:
    """The parts one after another; the separator is markup."""
    return Markup(separator.join(parts))


def number(value: float) -> str:
    """A coordinate with two decimals at most, without trailing zeros."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _attribute_name(key: str) -> str:
    return key.rstrip("_").replace("_", "-")


def _attribute_value(value: str | float) -> Markup:
    return escape(value if isinstance(value, str) else number(value))
