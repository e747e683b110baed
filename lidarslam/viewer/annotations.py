"""Colours of maps and paths, paths on a picture, and the strip below it: legend, size and scale bar."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.report.drawing import ramp, viridis
from lidarslam.viewer.view import View

Quantity = Literal["height", "intensity", "error", "rgb"]

UNKNOWN = (205, 205, 205)
"""Where there is no value."""
_CLIPPED = (2.0, 98.0)  # percent
_LEVELS = np.linspace(0.0, 1.0, 256)
_UNITS: dict[Quantity, tuple[str, str]] = {
    "height": ("z", " m"),
    "intensity": ("intensity", ""),
    "error": ("error", " m"),
}
Colour = tuple[int, int, int]
INK, PAPER, HALO = (20, 20, 20), (255, 255, 255), (255, 255, 255)
START = (255, 225, 40)
# Of the picture's width.
_TEXT, _LINE, _MARKER = 1 / 58, 1 / 320, 1 / 130
_LONGEST_BAR = 0.2
_END_WIDENING = 0.25  # of the marks of wide paths, relative to that of the paths
_LONGEST_NAME = 32

# On white paper: light ground, dark tops; dark for little light returned; pale for small errors.
_RAMPS: dict[Quantity, NDArray[np.uint8]] = {
    "height": ramp(_LEVELS, [(201, 209, 214), (140, 181, 199), (66, 138, 166), (41, 84, 135), (60, 28, 92)]),
    "intensity": ramp(_LEVELS, [(45, 30, 70), (120, 50, 110), (200, 85, 80), (240, 155, 60), (250, 220, 130)]),
    "error": viridis(_LEVELS)[::-1],
}


@dataclass(frozen=True, eq=False)
class ColourScale:
    """Values as colours: the lowest and highest 2 % are clipped; errors begin at 0."""

    quantity: Quantity  # any but rgb
    low: float
    high: float

    @property
    def ramp(self) -> NDArray[np.uint8]:
        """Colours (256, 3) from the low end to the high one."""
        return _RAMPS[self.quantity]

    @property
    def ends(self) -> tuple[str, str]:
        """The labels on both sides of the scale."""
        (label, unit), digits = _UNITS[self.quantity], 1 if self.high >= 1.0 or self.quantity == "height" else 3
        return f"{label} {self.low:.{digits}f}", f"{self.high:.{digits}f}{unit}"

    def colours(self, values: FloatArray) -> NDArray[np.uint8]:
        """Colours (N, 3) of values (N,); grey where there is none."""
        level = (values - self.low) * (255.0 / max(self.high - self.low, 1e-6))
        colours = self.ramp[np.nan_to_num(np.clip(level, 0.0, 255.0)).astype(np.uint8)]
        colours[np.isnan(values)] = UNKNOWN
        return colours


def levels(values: FloatArray) -> FloatArray:
    """Values (N,) from 0 to 1, the lowest and highest 2 % clipped."""
    if not len(values):
        return values
    low, high = np.percentile(values, _CLIPPED)
    return np.asarray(np.clip((values - low) / max(high - low, 1e-6), 0.0, 1.0))


def fit_scale(quantity: Quantity, values: FloatArray) -> ColourScale | None:
    """The scale that suits values (N,), NaN where there is none; None where there is none at all."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    low, high = np.percentile(known, _CLIPPED)
    return ColourScale(quantity, 0.0 if quantity == "error" else float(low), float(high))


@dataclass(frozen=True, eq=False)
class Entry:
    """A part of the strip: a symbol and its text."""

    text: str
    symbol_width: int = 0  # pixels
    # draws the symbol from a column on, about a row
    symbol: Callable[[ImageDraw.ImageDraw, float, float], None] | None = None


def draw_path(
    picture: Image.Image, view: View, positions: FloatArray, colours: Sequence[Colour], wider: float = 1.0
) -> None:
    """Draw a path through positions (N, 3) above everything, in the colours of its poses, widened by a factor."""
    pixels = view.project(positions)
    for first, last in _stretches(colours):
        _line(picture, pixels[first : last + 1], colours[last], wider * _line_width(view))


def draw_outline(picture: Image.Image, view: View, positions: FloatArray, colour: Colour, wider: float = 1.0) -> None:
    """Draw the outline below a path that is widened by a factor."""
    _line(picture, view.project(positions), colour, (wider + 1.0) * _line_width(view))


def draw_end(picture: Image.Image, view: View, position: FloatArray, colour: Colour, wider: float = 1.0) -> None:
    """Mark the first position (1, 3) with a disc, the last with a square of the colour; (0, 3): nothing."""
    for column, row in view.project(position).tolist():
        radius = view.width * _MARKER * (1.0 + _END_WIDENING * (wider - 1.0))
        _mark(ImageDraw.Draw(picture), column, row, radius, colour)


def line_entry(text: str, colour: Colour, width: int, wider: float = 1.0) -> Entry:
    """A line of the legend."""
    length, thick = round(width / 45), max(3, round((0.2 + wider) * width * _LINE))

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        pen.line([(column, row), (column + length, row)], fill=colour, width=thick)

    return Entry(short(text), length, symbol)


def end_entry(text: str, colour: Colour, width: int) -> Entry:
    """The mark of the first or the last pose in the legend."""
    radius = width * _MARKER

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        _mark(pen, column + radius, row, radius, colour)

    return Entry(text, round(2 * radius), symbol)


def ramp_entry(low: str, high: str, colours: NDArray[np.uint8], width: int) -> Entry:
    """A scale of colours (K, 3) from `low` to `high`."""
    height, font = round(width * _TEXT * 0.7), _font(width)
    before = round(font.getlength(low)) + round(width / 160)

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        pen.text((column, row), low, fill=INK, font=font, anchor="lm")
        for step, colour in enumerate(colours.tolist()):
            left = column + before + step
            pen.line([(left, row - height / 2), (left, row + height / 2)], tuple(colour))

    return Entry(high, before + len(colours), symbol)


def scale_entry(view: View) -> Entry:
    """The scale bar; its length is that of the text."""
    metres = round_length(_LONGEST_BAR * view.width * view.pixel_m)
    length, tick, thick = round(metres / view.pixel_m), view.width / 200, max(2, round(view.width / 500))

    def symbol(pen: ImageDraw.ImageDraw, column: float, row: float) -> None:
        left, right = round(column), round(column) + length
        pen.rectangle([left, row - thick / 2, right - 1, row + thick / 2], fill=INK)
        for end in (left, right - thick):
            pen.rectangle([end, row - tick, end + thick - 1, row + tick], fill=INK)

    return Entry(f"{metres:g} m", length, symbol)


def round_length(longest_m: float) -> float:
    """The longest of 1, 2, 5, 10, 20, 50, ... m, or decimal parts of them, up to a length."""
    power = 10.0 ** np.floor(np.log10(longest_m))
    return float(power * max(digit for digit in (1, 2, 5) if digit * power <= longest_m * (1.0 + 1e-9)))


def with_strip(picture: Image.Image, entries: Sequence[Entry]) -> Image.Image:
    """The picture above a strip with the entries from left to right, in as many rows as they need."""
    width, font, gap = picture.width, _font(picture.width), round(picture.width / 45)
    text_gap, margin, row_height = round(width / 160), round(width / 40), round(width * _TEXT * 2.0)
    rows: list[list[tuple[int, Entry]]] = [[]]
    column = margin
    for entry in entries:
        taken = entry.symbol_width + text_gap + round(font.getlength(entry.text))
        if rows[-1] and column + taken > width - margin:
            rows.append([])
            column = margin
        rows[-1].append((column, entry))
        column += taken + gap
    whole = Image.new("RGB", (width, picture.height + row_height * len(rows) + row_height // 2), PAPER)
    whole.paste(picture, (0, 0))
    pen = ImageDraw.Draw(whole)
    for number, row in enumerate(rows):
        middle = picture.height + row_height * (number + 0.5) + row_height // 4
        for column, entry in row:
            if entry.symbol is not None:
                entry.symbol(pen, column, middle)
            text_column = column + entry.symbol_width + text_gap
            pen.text((text_column, middle), entry.text, fill=INK, font=font, anchor="lm")
    return whole


def _font(width: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(width * _TEXT)


def short(text: str) -> str:
    """The text, shortened, without the characters that Pillow's font lacks."""
    text = text.encode("ascii", "replace").decode()
    return text if len(text) <= _LONGEST_NAME else f"{text[: _LONGEST_NAME - 3]}..."


def _mark(pen: ImageDraw.ImageDraw, column: float, row: float, radius: float, colour: Colour) -> None:
    box = [column - radius, row - radius, column + radius, row + radius]
    draw = pen.ellipse if colour == START else pen.rectangle
    draw(box, fill=colour, outline=INK if colour == START else HALO, width=max(1, round(radius / 4)))


def _line_width(view: View) -> float:
    return max(2.0, view.width * _LINE)


def _line(picture: Image.Image, pixels: FloatArray, colour: Colour, width: float) -> None:
    """A line (N, 2) with round joints; Pillow's own leave gaps between short pieces."""
    pen, radius = ImageDraw.Draw(picture), 0.5 * width
    pen.line(pixels.ravel().tolist(), fill=colour, width=round(width))
    for column, row in pixels.tolist():
        pen.ellipse([column - radius, row - radius, column + radius, row + radius], fill=colour)


def _stretches(colours: Sequence[Colour]) -> list[tuple[int, int]]:
    """First and last pose of each stretch of one colour; a stretch begins at the pose before it."""
    ends = [row for row in range(1, len(colours)) if row + 1 == len(colours) or colours[row + 1] != colours[row]]
    return list(zip([0, *ends[:-1]], ends, strict=True)) if ends else []
