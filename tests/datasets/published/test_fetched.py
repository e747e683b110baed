"""Sources named by URL: fetched once, whole or not at all."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.datasets.fetched import cache_folder, fetch, fetched, is_url, url_of

from ...conftest import lidarslam, succeeds

pytest.importorskip("fsspec")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LIDARSLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served") / "walk"
    folder.mkdir()
    rng = np.random.default_rng(4)
    for index in range(3):
        np.save(folder / f"{index:06d}.npy", rng.uniform(-5.0, 5.0, (200, 3)))
    np.savetxt(folder / "timestamps.txt", 0.1 * np.arange(3), fmt="%.9f")
    return folder


class Quiet(SimpleHTTPRequestHandler):
    """Serves files, and keeps what was asked for."""

    asked: ClassVar[list[str]] = []

    def log_request(self, *_: object) -> None:
        self.asked.append(self.path)


@contextlib.contextmanager
def _serving(handler: Callable[..., SimpleHTTPRequestHandler]) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        threading.Thread(target=http.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{http.server_port}"
        http.shutdown()


@pytest.fixture
def server(recording: Path) -> Iterator[str]:
    Quiet.asked.clear()
    with _serving(partial(Quiet, directory=str(recording.parent))) as url:
        yield url


def _same_files(one: Path, other: Path) -> bool:
    contents = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in (one, other))
    return next(contents) == next(contents)


def test_what_is_a_url() -> None:
    assert is_url("s3://bucket/office.mcap")
    assert is_url(Path("https://example.org/office.mcap"))  # a path has one slash less
    assert not any(map(is_url, ("office.mcap", "/data/office.mcap", "evalio:newer_college_2020/short", "../a:b/c")))
    assert fetched("office.mcap") == Path("office.mcap")


def test_a_folder_is_fetched_once_from_a_server_or_this_machine(server: str, recording: Path) -> None:
    path = fetched(f"{server}/walk/")
    assert path.name == "walk"
    assert path.is_relative_to(cache_folder())
    assert _same_files(path, recording)
    assert (url_of(path), url_of(recording)) == (f"{server}/walk/", None)
    asked = len(Quiet.asked)
    assert fetched(f"{server}/walk/") == path
    assert len(Quiet.asked) == asked
    url = f"file://{recording}"
    assert _same_files(fetched(url), recording)
    assert fetched(Path(url)) == fetched(url)


def test_a_file_goes_to_the_same_path_on_another_machine(server: str, recording: Path, cache: Path) -> None:
    """Where the head of a cluster has it, and nothing was fetched yet."""
    path = fetched(f"{server}/walk/000001.npy?version=2")
    assert path.read_bytes() == (recording / "000001.npy").read_bytes()
    assert path.name == "000001.npy"
    url = url_of(path)
    cache.rename(cache.with_name("of the head"))
    assert url is not None
    fetch(url, path)
    assert path.read_bytes() == (recording / "000001.npy").read_bytes()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("file:///data/nothing", "file:///data/nothing: is not there"),
        ("http://127.0.0.1:9/office.mcap", "http://127.0.0.1:9/office.mcap: "),
        ("memory://data/office", "sources are fetched from file, http, https, s3, gs alone"),
        ("reference://::http://127.0.0.1:9/office.json", "sources are fetched from"),
        ("https://example.org/simplecache::memory://office", "no chain of URLs"),
    ],
)
def test_what_cannot_be_fetched_leaves_nothing(url: str, message: str, cache: Path) -> None:
    with pytest.raises(InputError, match=message):
        fetched(url)
    assert not any(cache.rglob("*"))


class Ranged(SimpleHTTPRequestHandler):
    """Serves `content` from any byte on; the second answer, after one whether it is there, breaks off."""

    content: ClassVar[bytes] = np.random.default_rng(0).bytes(300_000)
    etag: ClassVar[str] = '"1"'
    has_ranges: ClassVar[bool] = True
    sent: ClassVar[list[int]] = []  # bytes of each answer

    def log_request(self, *_: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self._head(200, 0, len(self.content))

    def do_GET(self) -> None:
        first, _, last = self._range().removeprefix("bytes=").partition("-")
        part = self.content[int(first) : int(last or len(self.content)) + 1]
        self._head(206 if self._range() != "bytes=0-" else 200, int(first), len(part))
        part = part[:100_000] if len(self.sent) == 1 else part
        self.sent.append(len(part))
        with contextlib.suppress(OSError):
            self.wfile.write(part)
        if len(self.sent) == 2:
            time.sleep(0.5)  # what has arrived by then is read
        self.close_connection = True

    def _range(self) -> str:
        return self.headers.get("Range", "bytes=0-") if self.has_ranges else "bytes=0-"

    def _head(self, code: int, first: int, length: int) -> None:
        self.send_response(code)
        self.send_header("ETag", self.etag)
        if self.has_ranges:
            self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Length", str(length))
        if code == 206:
            self.send_header("Content-Range", f"bytes {first}-{first + length - 1}/{len(self.content)}")
        self.end_headers()


@pytest.fixture
def breaking_server() -> Iterator[str]:
    Ranged.sent.clear()
    with _serving(Ranged) as url:
        yield f"{url}/office.bin"


@pytest.mark.long
@pytest.mark.parametrize("changes", [False, True], ids=["the same file", "another meanwhile"])
@pytest.mark.parametrize("has_ranges", [True, False], ids=["from the middle", "from the start alone"])
def test_a_download_that_broke_off_is_continued(
    breaking_server: str, changes: bool, has_ranges: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Ranged, "has_ranges", has_ranges)
    monkeypatch.setattr("lidarslam.datasets.fetched._BLOCK_BYTES", 10_000)
    with pytest.raises(InputError, match="cannot be fetched"):
        fetched(breaking_server)
    if changes:
        monkeypatch.setattr(Ranged, "content", Ranged.content[::-1])
        monkeypatch.setattr(Ranged, "etag", '"2"')
    path = fetched(breaking_server)
    assert path.read_bytes() == Ranged.content
    assert (Ranged.sent[-1] == 300_000) == (changes or not has_ranges), "a part"
    assert Ranged.sent[-1] >= 200_000
    assert {file.name for file in path.parent.rglob("*")} == {"lock", "office.bin", "url.txt"}


def test_a_source_without_an_end_is_given_up(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarslam.datasets.fetched._MOST_BYTES", 10_000)
    with pytest.raises(InputError, match="are fetched from no source"):
        fetched(f"{server}/walk/")


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(InputError, match=r"pip install 'lidarslam\[remote\]'"):
        fetched("s3://bucket/office.mcap")


def test_commands_take_urls_as_sources_and_nothing_else(recording: Path) -> None:
    assert "scan-folder" in succeeds("info", f"file://{recording}")
    result = lidarslam("run", recording, "--out", "s3://bucket/run")
    assert result.exit_code == 2
    assert "only sources are fetched" in result.output
