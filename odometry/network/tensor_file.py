"""Tensors and a description in one file: safetensors, which unlike a pickle runs no code of whoever wrote it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import replacing

_PROGRAM = "lidarslam"
# A safetensors file begins with the length of its header in eight bytes, and the header is JSON.
_LENGTH_BYTES = 8
# What torch.save writes: an archive of pickles, or with old versions a bare pickle of protocol 2 to 5.
_PICKLE_STARTS = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")


@dataclass(frozen=True)
class Kind:
    """What a file is for.

    Attributes:
        name: in words, for errors and in the file: "weights".
        version: of the layout of its content; newer ones are refused.
    """

    name: str
    version: int


@dataclass(frozen=True, eq=False)
class TensorFile:
    """Named tensors, and whatever JSON can hold."""

    tensors: dict[str, Tensor]
    content: dict[str, Any]


def write_tensor_file(path: Path, kind: Kind, tensors: Mapping[str, Tensor], content: Mapping[str, Any]) -> None:
    """Write the file, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    header = {
        "program": _PROGRAM,
        "kind": kind.name,
        "version": str(kind.version),
        "content": json.dumps(content, ensure_ascii=False),
    }
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            save_file(plain, partial, metadata=header)
    except (OSError, SafetensorError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise OutputError(f"{path}: cannot be written ({reason})") from error


def read_tensor_file(path: Path, kind: Kind) -> TensorFile:
    """Read what `write_tensor_file` wrote.

    Raises:
        InputError: there is no such file, or it is none of this kind, or of a newer version.
    """
    _refuse_other_formats(path, kind)
    try:
        with safe_open(path, framework="pt") as file:
            content = _content(path, kind, file.metadata() or {})
            return TensorFile({name: file.get_tensor(name) for name in file.keys()}, content)  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: is damaged ({error}); copy or make it again") from error


def _refuse_other_formats(path: Path, kind: Kind) -> None:
    """Look at the first bytes only; nothing is loaded."""
    try:
        with path.open("rb") as file:
            start = file.read(_LENGTH_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected {kind.name} that {_PROGRAM} wrote") from None
    except (OSError, ValueError) as error:  # a null character in a name is a ValueError
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"{path}: cannot be read ({reason})") from error
    if start[_LENGTH_BYTES:] == b"{":
        return
    if start.startswith(_PICKLE_STARTS):
        raise InputError(
            f"{path}: is a pickle, as torch.save writes it, and could run any code; it was not opened."
            f" Expected {kind.name} that {_PROGRAM} wrote, a .safetensors file"
        )
    raise InputError(f"{path}: is no safetensors file; expected {kind.name} that {_PROGRAM} wrote")


def _content(path: Path, kind: Kind, header: Mapping[str, str]) -> dict[str, Any]:
    """The description, once program, kind and version are the expected ones."""
    if header.get("program") != _PROGRAM:
        raise InputError(f"{path}: was written by another program; expected {kind.name} that {_PROGRAM} wrote")
    if header.get("kind") != kind.name:
        raise InputError(f"{path}: holds {header.get('kind')}, not {kind.name}; name another file")
    version = header.get("version", "")
    if not version.isdecimal():
        raise InputError(f"{path}: its version {version!r} is no number; the file is damaged, make it again")
    if int(version) > kind.version:
        raise InputError(
            f"{path}: has {kind.name} of version {version}, this program knows {kind.version} at most;"
            f" use a newer {_PROGRAM}"
        )
    try:
        content = json.loads(header.get("content", ""))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its description is not JSON ({error}); make it again") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: its description is a {type(content).__name__}, not keys and values; make it again")
    return content
