"""The report in a real browser, spoken to over the DevTools protocol's pipe."""

import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from lidarslam.evaluation.report.report import render_html

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
DEADLINE_S = 60.0

DRAW_ALL = """
(async () => {
  dispatchEvent(new Event('beforeprint'));
  const plots = [...document.querySelectorAll('.plot')];
  const isDrawn = plot => plot.querySelector('svg.main-svg .trace, svg.main-svg .hm image');
  for (let i = 0; i < 100 && !plots.every(isDrawn); i++) await new Promise(done => setTimeout(done, 50));
  dispatchEvent(new Event('afterprint'));
  const isFitted = plot => plot.querySelector('svg.main-svg')?.clientWidth === plot.clientWidth;
  for (let i = 0; i < 100 && !plots.every(isFitted); i++) await new Promise(done => setTimeout(done, 50));
  return [plots.length, plots.filter(isDrawn).length];
})()
"""
# Texts of a plot that stick out of it.
OUTSIDE = """
[...document.querySelectorAll('.plot')].flatMap(plot => {
  const box = plot.getBoundingClientRect();
  return [...plot.querySelectorAll('text')].filter(t => {
    const b = t.getBoundingClientRect();
    return b.width && (b.left < box.left - 2 || b.right > box.right + 2 || b.bottom > box.bottom + 2);
  }).map(t => `${plot.getAttribute('aria-label')}: ${t.textContent}`);
})
"""
TEXT_COLOUR = "getComputedStyle(document.querySelector('.plot .xtick text')).fill"
TRACES_SHOWN = """
[...document.querySelectorAll('.plot')].map(plot => plot.data.filter(trace => trace.visible).map(trace => trace.name))
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


@pytest.mark.parametrize(("width", "theme"), [(1200, "light"), (420, "dark")])
def test_the_report_opens_without_complaint_from_its_own_file_alone(width, theme, page, browser):
    browser.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
    visit = browser.visit(page, width)
    plots, drawn = browser.evaluate(DRAW_ALL)
    assert plots > 25
    assert drawn == plots
    assert visit.complaints == []
    later = browser._summarise()
    assert later.complaints == []
    elsewhere = [address for address in visit.addresses + later.addresses if not address.startswith(("data:", "blob:"))]
    assert set(elsewhere) == {page.as_uri()}
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate("[...document.querySelectorAll('.plot')].every(p => p.getBoundingClientRect().width > 250)")
    assert browser.evaluate(OUTSIDE) == []


def test_the_legend_hides_a_method_in_all_plots_and_the_axis_turns_logarithmic(page, browser):
    browser.visit(page, 1200)
    browser.evaluate(DRAW_ALL)
    assert any("learned" in names for names in browser.evaluate(TRACES_SHOWN))
    browser.evaluate("document.querySelector('.legend button').click()")
    assert not any("learned" in names for names in browser.evaluate(TRACES_SHOWN))
    browser.evaluate("document.querySelector('.legend button').click()")
    assert any("learned" in names for names in browser.evaluate(TRACES_SHOWN))
    kind = "document.querySelector('button.log').closest('.panel').querySelector('.plot')._fullLayout.yaxis.type"
    before = browser.evaluate(kind)
    browser.evaluate("document.querySelector('button.log').click()")
    assert {before, browser.evaluate(kind)} == {"linear", "log"}


@pytest.mark.parametrize(("width", "theme"), [(1600, "dark"), (420, "light")])
def test_on_paper_plots_have_the_width_of_the_page_and_dark_text(width, theme, page, browser):
    browser.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
    browser.visit(page, width)
    browser.evaluate("dispatchEvent(new Event('beforeprint'))")
    right = "Math.max(...[...document.querySelectorAll('svg.main-svg')].map(s => s.getBoundingClientRect().right))"
    assert browser.evaluate(right) == pytest.approx(182 / 25.4 * 96, abs=2.0)
    assert browser.evaluate("document.querySelectorAll('details.table:not([open])').length") == 0
    assert browser.evaluate("document.querySelectorAll('.plot:not([data-drawn])').length") == 0
    browser.send("Emulation.setEmulatedMedia", media="print")
    browser.evaluate("new Promise(done => setTimeout(done, 600))")
    assert browser.evaluate(TEXT_COLOUR) == "rgb(92, 92, 92)"
    browser.send("Emulation.setEmulatedMedia", media="")
    assert browser.evaluate(DRAW_ALL)[0] > 25
    assert browser.evaluate(right) <= width
    assert (browser.evaluate(right) > 1000) is (width > 1000)


def test_an_injected_script_is_refused(page, browser):
    page.write_text(page.read_text().replace("<main>", "<main><script>document.title = 'run'</script>"))
    visit = browser.visit(page, 900)
    assert any("Content Security Policy" in complaint for complaint in visit.complaints)
    assert browser.evaluate("document.title") != "run"
