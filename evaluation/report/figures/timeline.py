"""When each method had track, when it lost it, and where it ended."""

from collections.abc import Mapping, Sequence

from evaluation.comparison.comparison import MethodResult, SequenceComparison
from evaluation.report.figures.figure import Figure
from evaluation.report.figures.palette import Style
from evaluation.report.figures.panel import RIGHT, Panel, draw_panel, scale_ticks, shortened, text
from evaluation.report.figures.scale import Scale, tick_texts, ticks
from evaluation.report.markup import Markup, element, escape
from evaluation.trajectory.lost_stretches import lost_stretches

_WIDTH, _GUTTER, _ROW = 760.0, 170.0, 22.0
_WIDEST_MESSAGE = 80
# The shortest loss is still seen.
_LEAST_PX = 2.0


def timeline_figure(sequence: SequenceComparison, styles: Mapping[str, Style]) -> Figure | None:
    """A strip for each method over the recording's time; None when no method has a trajectory."""
    begin_s, end_s = _span(sequence)
    if end_s <= begin_s:
        return None
    x = Scale(0.0, end_s - begin_s, 0.0, _WIDTH - _GUTTER - RIGHT)
    height = _ROW * len(sequence.methods) + 4.0
    values = ticks(0.0, x.high, 7)
    panel = Panel(
        "Tracking over the recording",
        "; ".join(f"{m.name}: {m.status}, {len(lost_stretches(m))} lost stretches" for m in sequence.methods),
        x.end,
        height,
        "time since the first scan [s]",
        scale_ticks(x, values.tolist(), tick_texts(values)),
        [],
        grid="x",
    )
    strips, labels = [], []
    for row, method in enumerate(sequence.methods):
        middle = _ROW * (row + 0.5) + 2.0
        strips.append(_strip(method, styles[method.name], x, middle, begin_s))
        labels.append(text(shortened(method.name, 26), -10.0, middle + 4.0, size=11.5, anchor="end"))
    return Figure(
        title="Where each method had track",
        caption="A thin line where scans were tracked, a high block where tracking was lost, nothing where poses end.",
        panels=[draw_panel(panel, strips, labels, left=_GUTTER)],
        columns=1,
    )


def _span(sequence: SequenceComparison) -> tuple[float, float]:
    """First and last stamp of all methods."""
    walked = [m.trajectory for m in sequence.methods if m.trajectory is not None and len(m.trajectory)]
    begins, ends = [float(t.stamps[0]) for t in walked], [float(t.stamps[-1]) for t in walked]
    return min(begins, default=0.0), max(ends, default=0.0)


def _strip(method: MethodResult, style: Style, x: Scale, middle: float, begin_s: float) -> Markup:
    if method.trajectory is None or not len(method.trajectory):
        said = shortened(f"{method.status}: {method.message}" if method.message else method.status, _WIDEST_MESSAGE)
        return text(said, 4.0, middle + 4.0, size=10.5, quiet=True)
    stamps = method.trajectory.stamps - begin_s
    line = element(
        "rect", x=x.at(float(stamps[0])), y=middle - 2.0, width=x.at(float(stamps[-1])) - x.at(float(stamps[0])),
        height=4.0, fill=style.colour, class_=style.fill_class,
    )  # fmt: skip
    blocks: Sequence[Markup] = [
        element(
            "rect", x=x.at(stretch.begin_s - begin_s), y=middle - 8.0, height=16.0, fill="#1a1a1a", class_="lost-block",
            width=max(x.at(stretch.end_s) - x.at(stretch.begin_s), _LEAST_PX),
        )
        for stretch in lost_stretches(method)
    ]  # fmt: skip
    return element("g", element("title", escape(method.name)), line, *blocks)
