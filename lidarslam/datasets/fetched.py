"""Sources named by URL, and the folder in which they are kept; the only file that knows fsspec."""

import fcntl
import hashlib
import logging
import os
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.core.text import safe_name, stays_below

logger = logging.getLogger(__name__)

# A path has lost one slash of two.
_URL = re.compile(r"([a-z][a-z0-9+.-]*):/+(.+)", re.DOTALL)
# Kinds of storage. Others of fsspec's lead to further URLs, or render templates from their content.
_STORAGE = ("file", "http", "https", "s3", "gs")
# Next to a fetched source.
_ABOUT = "url.txt"
# Seconds without a byte after which a server has failed.
_SILENCE_S = 60.0


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
    """Fetch a file or a folder whole, unless it is there; of several processes that need it, one does so."""
    if path.exists():
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (path.parent / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                logger.warning("fetching %s to %s", url, path.parent)
                (path.parent / _ABOUT).write_text(url, encoding="utf-8")
                with TemporaryDirectory(dir=path.parent) as partial:
                    _download(url, Path(partial, path.name)).rename(path)
    except Exception as error:  # each kind of storage has its own
        shutil.rmtree(path.parent, ignore_errors=True)
        if isinstance(error, InputError):
            raise
        raise InputError(f"{url}: cannot be fetched ({' '.join(str(error).split()) or repr(error)})") from error


def _download(url: str, place: Path) -> Path:
    try:
        from fsspec import url_to_fs

        storage, remote = url_to_fs(url, **_patience(url))
    except (ImportError, ValueError) as error:
        extra = "; pip install 'lidarslam[remote]'" if isinstance(error, ImportError) else ""
        raise InputError(f"{url}: {error}{extra}") from error
    if not url.endswith("/") and storage.isfile(remote):
        storage.get_file(remote, str(place))
        return place
    root = f"{remote.rstrip('/')}/"
    names = [name.removeprefix(root) for name in storage.find(root)] if storage.isdir(remote) else []
    if not names:
        raise InputError(f"{url}: is not there")
    for name in names:  # not get(recursive=True), which takes a folder of a web page for a file, too
        if not stays_below(name):
            raise InputError(f"{url}: lists a file elsewhere, {name}")
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        storage.get_file(f"{root}{name}", str(place / name))
    return place


def _patience(url: str) -> dict[str, Any]:
    """Options without a limit on the total time, as long as bytes arrive: the default is five minutes in all."""
    if not url.startswith("http"):
        return {}
    from aiohttp import ClientTimeout

    return {"client_kwargs": {"timeout": ClientTimeout(total=None, sock_connect=_SILENCE_S, sock_read=_SILENCE_S)}}
