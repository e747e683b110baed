"""Horizontal bars: time a scan, time a stage, memory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.comparison.number_text import number_text
from evaluation.report.figures.figure import Figure
from evaluation.report.figures.palette import Style
from evaluation.report.figures.panel import RIGHT, Panel, draw_panel, scale_ticks, shortened, text
from evaluation.report.figures.scale import Scale, tick_texts, ticks
from evaluation.report.markup import Markup, element, escape

_WIDTH, _GUTTER, _NOTE = 540.0, 150.0, 120.0
_LONGEST_NAME = 23


@dataclass(frozen=True)
class Bar:
    """A bar with its text.

    Attributes:
        label: left of the bar.
        value: its length.
        note: right of it.
        style: of its method.
        whisker: a longer value marked by a tick, such as a 95th percentile.
        minor: a thinner bar that belongs to the one above.
    """

    label: str
    value: float
    note: str
    style: Style
    whisker: float | None = None
    minor: bool = False


def time_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """Time a scan with that of the stages, and memory; None when nothing was measured."""
    time = [bar for method in sequence.methods for bar in _time_bars(method, styles[method.name])]
    memory = [
        Bar(m.name, m.peak_rss_mb / 1000.0, f"{number_text(m.peak_rss_mb / 1000.0, 2)} GB", styles[m.name])
        for m in sequence.methods
        if m.peak_rss_mb is not None
    ]
    panels = [bar_panel("Time a scan [ms]", "ms", time, _period_ms(sequence))] if time else []
    panels += [bar_panel("Peak memory [GB]", "GB", memory)] if memory else []
    if not panels:
        return None
    return Figure(
        title="Time and memory",
        caption=(
            "Median wall time from one finished scan to the next, the tick at its 95th percentile; below it, thinner,"
            " the median time of each stage (stages run beside one another, so they need not add up)."
            " Left of the dashed line a method keeps up with the sensor. Memory at its peak, children included."
        ),
        panels=panels,
    )


def bar_panel(title: str, unit: str, bars: Sequence[Bar], limit: float | None = None) -> Markup:
    """A panel of bars, one below the other; `limit` draws a dashed line where it is within reach."""
    width = _WIDTH - _GUTTER - _NOTE - RIGHT
    longest = max(max(bar.value, bar.whisker or 0.0) for bar in bars)
    if limit is not None and limit <= 2.5 * longest:
        longest = max(longest, 1.04 * limit)
    else:
        limit = None
    x = Scale(0.0, longest if longest > 0.0 else 1.0, 0.0, width)
    tops, height = _layout(bars)
    values = ticks(0.0, x.high, 4)
    panel = Panel(
        title,
        "; ".join(f"{bar.label} {bar.note}" for bar in bars),
        width + _NOTE,
        height,
        unit,
        scale_ticks(x, values.tolist(), tick_texts(values)),
        [],
        grid="x",
    )
    drawn = [_bar(bar, top, x) for bar, top in zip(bars, tops, strict=True)]
    lines = [] if limit is None else [_limit_line(x.at(limit), height)]
    labels = [_label(bar, top) for bar, top in zip(bars, tops, strict=True)]
    said = (
        []
        if limit is None
        else [text(f"{limit:.0f} ms from scan to scan", x.at(limit), -5.0, 10.0, "middle", quiet=True)]
    )
    return draw_panel(panel, lines, [*drawn, *labels, *said], left=_GUTTER)


def _layout(bars: Sequence[Bar]) -> tuple[list[float], float]:
    """The upper edge of each bar, and the height of all."""
    tops, y = [], 4.0
    for row, bar in enumerate(bars):
        if row and not bar.minor:
            y += 8.0
        tops.append(y)
        y += 13.0 if bar.minor else 18.0
    return tops, y + 4.0


def _label(bar: Bar, top: float) -> Markup:
    size, down = (10.0, 9.0) if bar.minor else (11.5, 11.5)
    return text(shortened(bar.label, _LONGEST_NAME), -8.0, top + down, size=size, anchor="end", quiet=bar.minor)


def _bar(bar: Bar, top: float, x: Scale) -> Markup:
    height = 8.0 if bar.minor else 14.0
    body = element(
        "rect", x=0.0, y=top, width=max(x.at(bar.value), 1.0), height=height, fill=bar.style.colour,
        fill_opacity=0.45 if bar.minor else None, class_=bar.style.fill_class,
    )  # fmt: skip
    end, marks = x.at(bar.value), []
    if bar.whisker is not None:
        end = max(end, x.at(bar.whisker))
        middle = top + height / 2.0
        reached = f"{x.at(bar.whisker):.1f}"
        d = f"M{x.at(bar.value):.1f},{middle:.1f}H{reached}M{reached},{top + 2.0:.1f}v{height - 4.0:.1f}"
        marks.append(element("path", d=d, stroke="#1a1a1a", stroke_width=1.3, class_="whisker", fill="none"))
    note = text(bar.note, end + 6.0, top + (7.8 if bar.minor else 11.0), size=10.0 if bar.minor else 11.0, quiet=True)
    return element("g", element("title", escape(f"{bar.label}: {bar.note}")), body, *marks, note)


def _limit_line(x_px: float, height: float) -> Markup:
    return element(
        "path", d=f"M{x_px:.1f},0V{height:.1f}", stroke="#5c5c5c", stroke_dasharray="4 3", class_="axis", fill="none"
    )


def _time_bars(method: MethodResult, style: Style) -> list[Bar]:
    stages = [
        Bar(stage, ms, f"{number_text(ms, 1)}", style, minor=True) for stage, ms in method.stage_ms.items() if ms >= 0.0
    ]
    if method.ms_per_scan_median is None:
        return [Bar(method.name, 0.0, "not measured", style), *stages] if stages else []
    p95 = method.ms_per_scan_p95
    note = number_text(method.ms_per_scan_median, 1) + ("" if p95 is None else f" (p95 {number_text(p95, 0)})")
    return [Bar(method.name, method.ms_per_scan_median, note, style, whisker=p95), *stages]


def _period_ms(sequence: SequenceComparison) -> float | None:
    """Time between two scans, of the first trajectory there is."""
    lengths = [m.trajectory for m in sequence.methods if m.trajectory is not None and len(m.trajectory) > 1]
    return 1e3 * float(np.median(np.diff(lengths[0].stamps))) if lengths else None
