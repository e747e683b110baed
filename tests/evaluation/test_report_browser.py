"""The report in a real browser, spoken to over the DevTools protocol's pipe."""

import base64
import json
import os
import select
import shutil
import struct
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from evaluation.report.report import render_html

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
DEADLINE_S = 60.0

# Every picture is decoded anew, as SVG's <image> does not say whether it was.
BROKEN_PICTURES = """
(async () => {
  const addresses = [...document.querySelectorAll('image')].map(i => i.getAttribute('href'))
    .concat([...document.images].map(i => i.src));
  const decoded = await Promise.all(addresses.map(address => {
    const picture = new Image();
    picture.src = address;
    return picture.decode().then(() => picture.naturalWidth, () => 0);
  }));
  return {pictures: addresses.length, broken: decoded.filter(width => !width).length};
})()
"""
OVERLAPS = """
[...document.querySelectorAll('svg.panel')].flatMap(panel => {
  const texts = [...panel.querySelectorAll('text')].filter(t => t.textContent).map(t => [t, t.getBoundingClientRect()]);
  return texts.flatMap(([a, p], i) => texts.slice(i + 1)
    .filter(([, q]) => Math.min(p.right, q.right) - Math.max(p.left, q.left) > 1
                    && Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top) > 3)
    .map(([b]) => `${panel.getAttribute('aria-label')}: ${a.textContent} / ${b.textContent}`));
})
"""
OUTSIDE = """
[...document.querySelectorAll('svg.panel')].flatMap(panel => {
  const box = panel.getBoundingClientRect();
  return [...panel.querySelectorAll('text')].filter(t => {
    const b = t.getBoundingClientRect();
    const across = b.left < box.left - 1 || b.right > box.right + 1;
    return b.width && (across || b.bottom > box.bottom + 1 || b.top < box.top - 1);
  }).map(t => `${panel.getAttribute('aria-label')}: ${t.textContent}`);
})
"""


@dataclass
class Visit:
    """What a page did while it was loaded: addresses asked for, failures, and what the console says."""

    addresses: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)


class Browser:
    """One page of a headless Chromium."""

    def __init__(self, process: subprocess.Popen[bytes], write: int, read: int) -> None:
        self._process, self._write, self._read = process, write, read
        self._received, self._number, self._session = b"", 0, None
        self.events: list[dict] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Log", "Runtime"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: object) -> dict:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def visit(self, path: Path, width: int) -> Visit:
        """Load a page and wait until it is drawn."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        self.events.clear()
        self.send("Page.navigate", url=path.as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())
        self.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")
        return self._summarise()

    def evaluate(self, expression: str) -> object:
        answer = self.send("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def screenshot(self) -> bytes:
        return base64.b64decode(self.send("Page.captureScreenshot", captureBeyondViewport=True)["data"])

    def _summarise(self) -> Visit:
        visit = Visit()
        for event in self.events:
            parameters = event["params"]
            match event["method"]:
                case "Network.requestWillBeSent":
                    visit.addresses.append(parameters["request"]["url"])
                case "Network.loadingFailed":
                    visit.complaints.append(f"not loaded: {parameters['errorText']}")
                case "Log.entryAdded":
                    visit.complaints.append(parameters["entry"]["text"])
                case "Runtime.exceptionThrown" | "Runtime.consoleAPICalled":
                    visit.complaints.append(json.dumps(parameters))
        return visit

    def _next(self) -> dict:
        end = time.monotonic() + DEADLINE_S
        while b"\0" not in self._received:
            readable, _, _ = select.select([self._read], [], [], max(0.0, end - time.monotonic()))
            chunk = os.read(self._read, 1 << 20) if readable else b""
            assert chunk, f"the browser gave no answer (exit status {self._process.poll()})"
            self._received += chunk
        message, _, self._received = self._received.partition(b"\0")
        return json.loads(message)


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    """A headless Chromium that reads commands from file descriptor 3 and answers on 4."""
    program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no browser found; looked for {', '.join(BROWSERS)}")
    (commands_out, commands_in), (answers_out, answers_in) = os.pipe(), os.pipe()
    profile = tmp_path_factory.mktemp("profile")
    arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    arguments += ["--disable-background-networking", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
    process = subprocess.Popen(
        ["/bin/bash", "-c", f'exec "$0" "$@" 3<&{commands_out} 4>&{answers_in}', program, *arguments],
        pass_fds=(commands_out, answers_in),
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    os.close(commands_out)
    os.close(answers_in)
    try:
        yield Browser(process, commands_in, answers_out)
    finally:
        os.close(commands_in)
        os.close(answers_out)
        process.terminate()
        process.wait(DEADLINE_S)


@pytest.fixture
def page(comparison, tmp_path) -> Path:
    path = tmp_path / "report.html"
    path.write_text(render_html(comparison), encoding="utf-8")
    return path


@pytest.mark.parametrize("width", [1400, 900, 480])
def test_the_report_opens_without_complaint_from_its_own_file_alone(width, page, browser):
    visit = browser.visit(page, width)
    assert visit.complaints == []
    elsewhere = [address for address in visit.addresses if not address.startswith("data:")]
    assert elsewhere == [page.as_uri()]
    found = browser.evaluate(BROKEN_PICTURES)
    assert found["pictures"] > 0
    assert found["broken"] == 0
    assert browser.evaluate("document.scripts.length") == 0
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate(
        "[...document.querySelectorAll('svg.panel')].every(p => p.getBoundingClientRect().width > 250)"
    )


def test_no_text_of_a_figure_lies_on_another_or_is_cut_off(page, browser):
    browser.visit(page, 1400)
    assert browser.evaluate(OVERLAPS) == []
    assert browser.evaluate(OUTSIDE) == []


def test_a_picture_of_the_page_shows_it(page, browser):
    browser.visit(page, 1400)
    png = browser.screenshot()
    width, height = struct.unpack(">II", png[16:24])
    assert 1380 <= width <= 1400  # less the scroll bar
    assert height > 3000
    assert len(png) > 200_000


def test_a_page_that_fetches_or_runs_is_told_on(browser, tmp_path):
    path = tmp_path / "bad.html"
    texts = "<text y='14'>one</text><text y='14' x='5'>other, and far too long for it</text>"
    drawing = f"<svg class='panel' width='90' height='24'>{texts}</svg>"
    script = "<script>console.error('x'); undefined.y</script>"
    path.write_text(f"<img src='missing.png'>{drawing}{script}", encoding="utf-8")
    visit = browser.visit(path, 900)
    assert any(address.endswith("missing.png") for address in visit.addresses)
    assert len(visit.complaints) >= 3
    assert browser.evaluate(BROKEN_PICTURES) == {"pictures": 1, "broken": 1}
    assert len(browser.evaluate(OVERLAPS)) == 1
    assert len(browser.evaluate(OUTSIDE)) == 1
