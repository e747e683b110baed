"""Text that any page can hold."""

import re

# Characters that XML cannot hold in any spelling, lone surrogates included, which no file could be written with either.
_UNPRINTABLE = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def printable(text: str) -> str:
    """The text with U+FFFD for characters that a page cannot hold."""
    return _UNPRINTABLE.sub("\ufffd", text)
