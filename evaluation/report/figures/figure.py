"""A figure: panels, a legend that names the methods, and a caption."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from evaluation.report.figures.palette import Style, swatch
from evaluation.report.markup import Markup, element, escape, join


@dataclass(frozen=True)
class Figure:
    """What stands under one number.

    Attributes:
        title: a few words, the caption's beginning.
        caption: what is shown, in which units and frames.
        panels: SVG elements.
        legend: entries above the panels.
        columns: how many panels stand beside one another on a wide page.
    """

    title: str
    caption: str
    panels: Sequence[Markup]
    legend: Sequence[Markup] = ()
    columns: int = 2


def figure_html(figure: Figure, number: int) -> Markup:
    """The figure as an element of a page."""
    entries = [element("li", entry) for entry in figure.legend]
    panels = element("div", *figure.panels, class_=f"panels panels-{figure.columns}")
    caption = element(
        "figcaption", element("b", escape(f"Figure {number}. {figure.title}.")), Markup(" "), escape(figure.caption)
    )
    legend = [element("ul", *entries, class_="legend")] if entries else []
    return element("figure", *legend, panels, caption, id=f"figure-{number}")


def method_keys(names: Iterable[str], styles: Mapping[str, Style]) -> list[Markup]:
    """Legend entries of methods."""
    return [join([swatch(styles[name]), element("span", escape(name), class_="name")]) for name in names]


def reference_key(name: str) -> Markup:
    """Legend entry of the reference, a broad grey line."""
    line = element("path", d="M1,6H33", class_="reference", stroke="#b4b4b4", stroke_width=4.5)
    return join([_key_picture(line), escape(name)])


def lost_key() -> Markup:
    """Legend entry of stretches where tracking was lost."""
    halo = element(
        "path", d="M4,6H30", class_="lost-halo axis", stroke="#5c5c5c", stroke_width=7.0, stroke_opacity=0.35
    )
    return join([_key_picture(join([halo, lost_cross(17, 6)])), escape("tracking lost")])


def lost_cross(x: float, y: float) -> Markup:
    """The sign for the beginning of a lost stretch."""
    d = f"M{x - 3.5:.1f},{y - 3.5:.1f}l7,7m0,-7l-7,7"
    return element("path", d=d, class_="lost-cross", stroke="#111111", stroke_width=1.8, fill="none")


def _key_picture(content: Markup) -> Markup:
    return element("svg", content, class_="swatch", width="34", height="12", viewBox="0 0 34 12", aria_hidden="true")
