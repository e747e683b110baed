"""Tensors and a description in one file: safetensors, which unlike a pickle runs no code of whoever wrote it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import replacing
from lidarslam.core.text.json_text import ANY_OBJECT, parse_json

_PROGRAM = "lidarslam"
_VERSION = TypeAdapter(Annotated[int, Field(ge=0, lt=1 << 31)])


@dataclass(frozen=True)
class Kind:
    """The purpose of a file, in words ("weights"), and the version of its layout; newer ones are refused."""

    name: str
    version: int


def write_tensor_file(path: Path, kind: Kind, tensors: Mapping[str, Tensor], content: Mapping[str, Any]) -> None:
    """Write the file, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    header = {"program": _PROGRAM, "kind": kind.name, "version": str(kind.version), "content": json.dumps(content)}
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            save_file(plain, partial, metadata=header)
    except (OSError, SafetensorError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise OutputError(f"{path}: cannot be written ({reason})") from error


def read_tensor_file(path: Path, kind: Kind) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The named tensors and the description that `write_tensor_file` wrote.

    Raises:
        InputError: there is no such file, or it is none of this kind, or of a newer version.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected {kind.name} that {_PROGRAM} wrote") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(
            f"{path}: is no safetensors file; expected {kind.name} that {_PROGRAM} wrote, it may be damaged ({error})"
        ) from error
    if header.get("program") != _PROGRAM or header.get("kind") != kind.name:
        found = header.get("kind") if header.get("program") == _PROGRAM else "tensors of another program"
        raise InputError(f"{path}: holds {found}, not {kind.name} that {_PROGRAM} wrote; name another file")
    try:
        content = parse_json(header["content"], ANY_OBJECT)
        version = _VERSION.validate_python(header["version"])
    except ValidationError:
        raise InputError(f"{path}: its version is no number; make it again") from None
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: its description is damaged ({error}); make it again") from error
    if version > kind.version:
        raise InputError(
            f"{path}: has {kind.name} of version {version}, this program reads {kind.version} at most;"
            f" use a newer {_PROGRAM}"
        )
    return tensors, content
