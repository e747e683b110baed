"""YAML in and out: plain values only, never tags that make objects; settings with a comment and their bounds each."""

import re
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import yaml
from annotated_types import Ge, Le
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lidarslam.core.errors import ConfigError
from lidarslam.core.text import one_line

# A configuration has a few kilobytes.
_LONGEST_BYTES = 4 << 20
_MERGE_TAG = "tag:yaml.org,2002:merge"
# Comments begin at this column at the latest, unless the setting is longer.
_LAST_COLUMN = 48
_FIRST_CLAUSE = re.compile(r"[.;\n]")
# Numbers as YAML 1.2 has them; in 1.1, which PyYAML reads, 010 is eight and 1:30 is ninety.
_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan")
_NUMBERS = {"tag:yaml.org,2002:int": _INT, "tag:yaml.org,2002:float": _FLOAT}


class YamlError(ConfigError):
    """A text that is not valid YAML; the message is one line.

    Attributes:
        is_syntax: whether only the syntax is wrong, so that it may be meant as a plain text.
    """

    def __init__(self, message: str, is_syntax: bool = False) -> None:
        super().__init__(message)
        self.is_syntax = is_syntax


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that occurs twice in a section; any value that is no decimal number is a text."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        tag = super().resolve(kind, value, implicit)  # type: ignore[no-untyped-call]
        is_plain = kind is yaml.ScalarNode and implicit[0] and tag in _NUMBERS
        return self.DEFAULT_SCALAR_TAG if is_plain and not _NUMBERS[tag].fullmatch(value) else tag

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else []:
            key: Any = None if key_node.tag == _MERGE_TAG else self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key is not None:
                if key in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key!r} occurs twice", key_node.start_mark
                    )
                seen.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str) -> Any:
    """The values of a text; YamlError where it is not YAML, asks for other objects, or a key occurs twice."""
    try:
        return yaml.load(text, Loader=_StrictLoader)  # noqa: S506 # a SafeLoader that refuses more
    except yaml.YAMLError as error:
        raise YamlError(f"not YAML: {' '.join(str(error).split())}", is_syntax=True) from error
    except (RecursionError, ValueError, AttributeError) as error:  # too deep, or converted without a check: 2021-13-45
        raise YamlError(f"not YAML: {error}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a file; ConfigError where it cannot be read, is too long, or has none."""
    try:
        with path.open("rb") as file:
            content = file.read(_LONGEST_BYTES + 1)
        if len(content) > _LONGEST_BYTES:
            raise ConfigError(f"{path}: is longer than {_LONGEST_BYTES >> 20} MB; expected a file of settings")
        tree = parse_yaml(content.decode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the file cannot be read ({one_line(str(error))})") from error
    except YamlError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not isinstance(tree, dict | None):
        raise ConfigError(f"{path}: expected keys and values, got a {type(tree).__name__}")
    return tree or {}


def settings_as_yaml(settings: BaseModel) -> str:
    """Every setting on a line with its description, every section below its title."""
    return "\n".join(_section(settings, "")).lstrip("\n") + "\n"


def _section(settings: BaseModel, indent: str) -> Iterator[str]:
    values = settings.model_dump(mode="json")
    entries = [(name, field, getattr(settings, name)) for name, field in type(settings).model_fields.items()]
    plain = {name: f"{indent}{name}: {_flow(values[name])}" for name, _, value in entries if not _is_section(value)}
    column = min(max(map(len, plain.values()), default=0), _LAST_COLUMN)
    for name, field, value in entries:
        if _is_section(value):
            if not indent:
                yield ""
            title = field.description or (type(value).__doc__ or "")
            yield f"{indent}# {_FIRST_CLAUSE.split(title.strip())[0]}"
            yield f"{indent}{name}:"
            yield from _section(value, f"{indent}  ")
        else:
            bounds = bounds_text(field)
            comment = " ".join(filter(None, (field.description, bounds and f"[{bounds}]")))
            yield f"{plain[name]:{column}}  # {comment}" if comment else plain[name]


def _is_section(value: Any) -> bool:
    return isinstance(value, BaseModel)


def _flow(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=float("inf"))
    return text.removesuffix("\n").removesuffix("\n...")


def bounds_of(field: FieldInfo) -> tuple[float, float] | None:
    """The least and the largest value of a number, also where it may be null or is in a tuple; None of no number."""
    marks = list(_marks(field.metadata, field.annotation))
    low = next((mark.ge for mark in marks if isinstance(mark, Ge)), None)
    high = next((mark.le for mark in marks if isinstance(mark, Le)), None)
    return None if low is None or high is None else (low, high)  # type: ignore[return-value] # they are numbers


def bounds_text(field: FieldInfo) -> str | None:
    """Bounds in words: `0.01 to 10` or `[3 numbers, 0 to 1]`, or words that may stand instead; None of no number."""
    bounds = bounds_of(field)
    if bounds is None:
        return None
    words = [word for kind in get_args(field.annotation) if get_origin(kind) is Literal for word in get_args(kind)]
    numbers = " to ".join(f"{b:,.0f}" if b == int(b) else f"{b:g}" for b in bounds)
    length = next((len(get_args(kind)) for kind in get_args(field.annotation) if get_origin(kind) is tuple), None)
    return " or ".join([numbers if length is None else f"[{length} numbers, {numbers}]", *words])


def _marks(metadata: list[Any], annotation: Any) -> Iterator[Any]:
    for mark in metadata:
        yield from mark.metadata if isinstance(mark, FieldInfo) else (mark,)
    for part in get_args(annotation):
        yield from _marks(list(getattr(part, "__metadata__", ())), part)
