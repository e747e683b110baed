"""Sources named by URL, and the folder in which they are kept; the only file that knows fsspec."""

import fcntl
import hashlib
import json
import logging
import os
import re
import shutil
from pathlib import Path
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.core.text import safe_name, stays_below

logger = logging.getLogger(__name__)

# A path has lost one slash of two.
_URL = re.compile(r"([a-z][a-z0-9+.-]*):/+(.+)", re.DOTALL)
# Kinds of storage. Others of fsspec's lead to further URLs, or render templates from their content.
_STORAGE = ("file", "http", "https", "s3", "gs")
# Next to a fetched source; and the parts fetched so far, with the version of each file.
_ABOUT, _PARTIAL, _VERSION = "url.txt", ".partial", ".fetched-version"
# Properties of a stored file that change with its content, besides its size.
_CHANGING = ("ETag", "etag", "Last-Modified", "LastModified", "md5Hash", "generation", "mtime")
# Bytes of a source at most, and of one read; seconds without a byte after which a server has failed.
_MOST_BYTES, _BLOCK_BYTES, _SILENCE_S = 2**40, 2**23, 60.0


def is_url(source: str | Path) -> bool:
    """Whether a source is named by URL."""
    return _URL.fullmatch(str(source)) is not None


def cache_folder() -> Path:
    """Where fetched sources are kept: LIDARSLAM_CACHE, or lidarslam in the user's cache folder."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("LIDARSLAM_CACHE") or Path(cache) / "lidarslam").absolute()


def fetched(source: str | os.PathLike[str]) -> Path:
    """The path of a source, which is fetched first where it is named by URL and not there yet.

    Over http a folder is known by the slash at the end of its URL.
    """
    parts = _URL.fullmatch(os.fspath(source))
    if parts is None:
        return Path(source)
    scheme, rest = parts[1], parts[2]
    url = f"{scheme}://{'/' if scheme == 'file' else ''}{rest}"
    if scheme not in _STORAGE or "::" in url:
        raise InputError(f"{url}: sources are fetched from {', '.join(_STORAGE)} alone, and from no chain of URLs (::)")
    name = rest.partition("?")[0].rstrip("/").rpartition("/")[2]
    path = cache_folder() / hashlib.sha256(url.encode()).hexdigest()[:16] / safe_name(name)
    fetch(url, path)
    return path


def url_of(path: Path) -> str | None:
    """The URL that a source was fetched from; None of any other."""
    about = path.parent / _ABOUT
    if path.parent.parent.absolute() != cache_folder() or not about.is_file():
        return None
    return about.read_text(encoding="utf-8")


def fetch(url: str, path: Path) -> None:
    """Fetch a file or a folder, unless it is there; of several processes that need it, one does so.

    An interrupted download is continued, where the storage can read from the middle of a file.
    """
    if path.exists():
        return
    partial = path.parent / _PARTIAL
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (path.parent / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                logger.warning("fetching %s to %s", url, path.parent)
                (path.parent / _ABOUT).write_text(url, encoding="utf-8")
                _download(url, partial / path.name)
                for note in partial.rglob(f"*{_VERSION}"):
                    note.unlink()
                (partial / path.name).rename(path)
                shutil.rmtree(partial)
    except Exception as error:  # each kind of storage has its own
        if not any(file.stat().st_size for file in partial.rglob("*") if file.suffix != _VERSION and file.is_file()):
            shutil.rmtree(path.parent, ignore_errors=True)
        if isinstance(error, InputError):
            raise
        raise InputError(f"{url}: cannot be fetched ({' '.join(str(error).split()) or repr(error)})") from error


def _download(url: str, place: Path) -> None:
    try:
        from fsspec import url_to_fs

        storage, remote = url_to_fs(url, **_patience(url))
    except ImportError as error:
        raise InputError(f"{url}: {error}; pip install 'lidarslam[remote]'") from error
    except ValueError as error:
        raise InputError(f"{url}: {error}") from error
    if not url.endswith("/") and storage.isfile(remote):
        _download_file(storage, remote, place, 0)
        return
    root = f"{remote.rstrip('/')}/"
    names = [name.removeprefix(root) for name in storage.find(root)] if storage.isdir(remote) else []
    if not names:
        raise InputError(f"{url}: is not there")
    fetched_bytes = 0
    for name in names:  # not get(recursive=True), which takes a folder of a web page for a file, too
        if not stays_below(name):
            raise InputError(f"{url}: lists a file elsewhere, {name}")
        fetched_bytes = _download_file(storage, f"{root}{name}", place / name, fetched_bytes)


def _patience(url: str) -> dict[str, Any]:
    """Options without a limit on the total time, as long as bytes arrive: the default is five minutes in all."""
    if not url.startswith("http"):
        return {}
    from aiohttp import ClientTimeout

    return {"client_kwargs": {"timeout": ClientTimeout(total=None, sock_connect=_SILENCE_S, sock_read=_SILENCE_S)}}


def _download_file(storage: Any, remote: str, place: Path, before: int) -> int:
    """Fetch the missing part of a file; return the bytes of the source so far, which were `before` without it."""
    about = storage.info(remote)
    size = about.get("size")
    marks = [str(about[key]) for key in _CHANGING if about.get(key) is not None]
    version = json.dumps([size, *marks])
    noted = place.with_name(place.name + _VERSION)
    place.parent.mkdir(parents=True, exist_ok=True)
    is_known = size is not None and bool(marks) and noted.is_file()
    if not is_known or noted.read_text(encoding="utf-8") != version:
        place.unlink(missing_ok=True)
        noted.write_text(version, encoding="utf-8")
    try:
        return before + _append(storage, remote, place, size, before)
    except ValueError:  # the storage does not read from the middle of a file
        if not place.stat().st_size:
            raise
        place.unlink()
        return before + _append(storage, remote, place, size, before)


def _append(storage: Any, remote: str, place: Path, size: int | None, before: int) -> int:
    with place.open("ab") as file:
        # Over http, several requests want a server that reads from the middle of a file.
        streamed = {"block_size": 0} if not file.tell() and hasattr(storage, "client_kwargs") else {}
        with storage.open(remote, "rb", **streamed) as source:
            if file.tell():
                source.seek(file.tell())
            while file.tell() != size and (block := source.read(_BLOCK_BYTES)):
                if before + file.tell() + len(block) > _MOST_BYTES:
                    raise InputError(f"{remote}: more than {_MOST_BYTES / 1e12:.1f} TB are fetched from no source")
                file.write(block)
        if size is not None and file.tell() != size:
            raise InputError(f"{remote}: {file.tell():,} of {size:,} bytes arrived; the next attempt continues")
        return file.tell()
