"""Sources named by URL, and the folder in which they are kept; the only file that knows fsspec."""

import fcntl
import hashlib
import logging
import os
import re
import shutil
import tempfile
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.text.names import safe_name, stays_below

logger = logging.getLogger(__name__)

# A path has lost one slash of two.
_URL = re.compile(r"([a-z][a-z0-9+.-]*):/+(.+)", re.DOTALL)
# Beside a fetched source.
_ABOUT = "url.txt"


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

    Raises:
        InputError: it cannot be fetched.
    """
    parts = _URL.fullmatch(os.fspath(source))
    if parts is None:
        return Path(source)
    scheme, rest = parts[1], parts[2]
    url = f"{scheme}://{'/' if scheme == 'file' else ''}{rest}"
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
    """Fetch a file or a folder, unless it is there; of several processes that want it, one does so.

    Raises:
        InputError: fsspec or the library for this kind of URL is not installed, or it cannot be fetched.
    """
    if path.exists():
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (path.parent / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                logger.warning("fetching %s to %s", url, path.parent)
                (path.parent / _ABOUT).write_text(url, encoding="utf-8")
                with tempfile.TemporaryDirectory(prefix=".partial-", dir=path.parent) as folder:
                    _download(url, Path(folder) / path.name)
                    (Path(folder) / path.name).rename(path)
    except InputError:
        shutil.rmtree(path.parent, ignore_errors=True)
        raise
    except Exception as error:  # each kind of storage has its own
        shutil.rmtree(path.parent, ignore_errors=True)
        raise InputError(f"{url}: cannot be fetched ({' '.join(str(error).split()) or repr(error)})") from error


def _download(url: str, place: Path) -> None:
    try:
        from fsspec import url_to_fs

        storage, remote = url_to_fs(url)
    except ImportError as error:
        raise InputError(f"{url}: {error}; pip install 'lidarslam[remote]'") from error
    except ValueError as error:
        raise InputError(f"{url}: {error}") from error
    if not url.endswith("/") and storage.isfile(remote):
        storage.get_file(remote, str(place))
        return
    root = f"{remote.rstrip('/')}/"
    names = [name.removeprefix(root) for name in storage.find(root)] if storage.isdir(remote) else []
    if not names:
        raise InputError(f"{url}: is not there")
    for name in names:  # not get(recursive=True), which takes a folder of a web page for a file, too
        if not stays_below(name):
            raise InputError(f"{url}: lists a file elsewhere, {name}")
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        storage.get_file(f"{root}{name}", str(place / name))
