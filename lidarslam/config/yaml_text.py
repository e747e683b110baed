"""YAML as plain values; the only file that imports yaml to read, and never with tags that make objects."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from lidarslam.core.plain_text import one_line

# A configuration is a few kilobytes.
_LONGEST_BYTES = 4 << 20
# What PyYAML lets through besides its own errors: a value with the form of a date or number (2021-13-45), and nesting
# that its parser follows call by call.
_UNREADABLE = (yaml.YAMLError, ValueError, AttributeError, RecursionError)
_MERGE_TAG = "tag:yaml.org,2002:merge"


class YamlError(ValueError):
    """A text that is not the YAML that is meant; its message is one line.

    Attributes:
        is_syntax: whether the text would be YAML if it were written otherwise, so that it may be meant as a plain text.
    """

    def __init__(self, message: str, is_syntax: bool = False) -> None:
        super().__init__(message)
        self.is_syntax = is_syntax


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that stands twice in a section, of which the later would win unseen."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else []:
            if key_node.tag == _MERGE_TAG:
                continue
            key: Any = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} stands twice", key_node.start_mark
                )
            if isinstance(key, Hashable):
                seen.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str) -> Any:
    """The values of a text: dictionaries, lists, texts, numbers, dates, null.

    Raises:
        YamlError: it is not YAML, asks for other objects, or a key stands twice.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)  # a SafeLoader that refuses more
    except _UNREADABLE as error:
        if isinstance(error, yaml.YAMLError):
            raise YamlError(f"not YAML: {' '.join(str(error).split())}", is_syntax=True) from error
        if isinstance(error, RecursionError):
            raise YamlError("not YAML: it is nested too deeply") from error
        raise YamlError(f"a value looks like a date or a number but is none: {error}") from error


def read_yaml(path: Path) -> Any:
    """The values of a file in UTF-8.

    Raises:
        YamlError: it cannot be read, is longer than any configuration, or is not YAML.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_LONGEST_BYTES + 1)
        if len(content) > _LONGEST_BYTES:
            raise YamlError(f"is longer than {_LONGEST_BYTES >> 20} MB; expected a file of settings")
        text = content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise YamlError(f"the file cannot be read ({one_line(str(error))})") from error
    return parse_yaml(text)
