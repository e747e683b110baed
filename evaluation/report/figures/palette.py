"""What tells methods apart in every figure: a colour that colour-blind readers can tell too, a dash, a marker."""

from collections.abc import Iterable
from dataclasses import dataclass

from evaluation.report.markup import Markup, element, number

# Okabe and Ito's colours without yellow, which white paper swallows, then two of Paul Tol's. As light ones on dark
# ground, the same hues.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#7f7f1c")
COLOURS_ON_DARK = ("#4aa3df", "#f08a4b", "#2fc79a", "#e29bc4", "#f2b844", "#86cdf6", "#d46a9f", "#bdbd4f")
# Numbers without a common divisor: 8 colours, 5 dashes and 7 markers repeat together after 280 methods only.
_DASHES = ("", "7 2.5", "2.2 2.2", "9 2.5 2 2.5", "13 3.5")
_MARKERS = ("circle", "square", "triangle", "diamond", "down", "plus", "cross")

_SHAPES = {
    "circle": "M-3.4,0a3.4,3.4 0 1,0 6.8,0a3.4,3.4 0 1,0 -6.8,0Z",
    "square": "M-3,-3H3V3H-3Z",
    "triangle": "M0,-3.9L3.7,2.7H-3.7Z",
    "diamond": "M0,-4.3L4.1,0L0,4.3L-4.1,0Z",
    "down": "M0,3.9L3.7,-2.7H-3.7Z",
    "plus": "M-1.2,-3.8H1.2V-1.2H3.8V1.2H1.2V3.8H-1.2V1.2H-3.8V-1.2H-1.2Z",
    "cross": "M-3.6,-1.9L-1.9,-3.6L0,-1.7L1.9,-3.6L3.6,-1.9L1.7,0L3.6,1.9L1.9,3.6L0,1.7L-1.9,3.6L-3.6,1.9L-1.7,0Z",
}


@dataclass(frozen=True)
class Style:
    """How a method is drawn.

    Attributes:
        order: its place among the methods of the report.
        colour: on white, as #rrggbb; the page's style sheet replaces it on dark ground by the class.
        dash: SVG's stroke-dasharray; empty for a solid line.
        marker: the name of a shape.
    """

    order: int
    colour: str
    dash: str
    marker: str

    @property
    def stroke_class(self) -> str:
        """The style sheet's class for lines."""
        return f"s{self.order % len(COLOURS)}"

    @property
    def fill_class(self) -> str:
        """The style sheet's class for areas."""
        return f"f{self.order % len(COLOURS)}"


def method_styles(names: Iterable[str]) -> dict[str, Style]:
    """A style for each name, by the order of first appearance."""
    distinct = dict.fromkeys(names)
    return {
        name: Style(
            order, COLOURS[order % len(COLOURS)], _DASHES[order % len(_DASHES)], _MARKERS[order % len(_MARKERS)]
        )
        for order, name in enumerate(distinct)
    }


def marker(style: Style, x: float, y: float) -> Markup:
    """The method's marker at a place, about 7 px large, with a rim that sets it off from lines beneath."""
    return element(
        "path",
        d=_SHAPES[style.marker],
        transform=f"translate({number(x)},{number(y)})",
        fill=style.colour,
        class_=f"marker {style.fill_class}",
    )


def swatch(style: Style) -> Markup:
    """A piece of the method's line with its marker, 34 by 12 px, for legends and tables."""
    line = element(
        "path",
        d="M1,6H33",
        fill="none",
        stroke=style.colour,
        stroke_width=2.0,
        stroke_dasharray=style.dash or None,
        class_=style.stroke_class,
    )
    return element(
        "svg",
        line,
        marker(style, 17, 6),
        class_="swatch",
        width="34",
        height="12",
        viewBox="0 0 34 12",
        aria_hidden="true",
    )
