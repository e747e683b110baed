"""The report of a comparison: a page that opens offline by itself, and the same tables as Markdown."""

from collections.abc import Mapping, Sequence
from itertools import count

from evaluation.comparison.comparison import Comparison
from evaluation.comparison.table import Table
from evaluation.report.figures.figure import Figure, figure_html
from evaluation.report.figures.palette import Style, method_styles
from evaluation.report.markup import Markup, element, escape, join
from evaluation.report.overview import settings_texts
from evaluation.report.sections import Section, made_with_section, overview_section, sequence_section
from evaluation.report.style import style_sheet
from evaluation.report.table_html import table_html
from evaluation.report.table_markdown import code_block, markdown_text, table_markdown

# Nothing may be fetched and nothing may run: whatever a name or a message holds, it stays text.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def render_html(comparison: Comparison) -> str:
    """The report as one HTML page without scripts and without anything from elsewhere; it is well-formed XML too."""
    styles = method_styles(method.name for sequence in comparison.sequences for method in sequence.methods)
    sections = [
        overview_section(comparison),
        *(sequence_section(sequence, styles) for sequence in comparison.sequences),
        made_with_section(comparison),
    ]
    body = element(
        "main", *_header(comparison), *_sections_html(sections, styles), *_settings_html(comparison),
    )  # fmt: skip
    head = element(
        "head",
        Markup('<meta charset="utf-8"/>'),
        Markup('<meta name="viewport" content="width=device-width, initial-scale=1"/>'),
        Markup(f'<meta http-equiv="Content-Security-Policy" content="{escape(_POLICY)}"/>'),
        element("title", escape(comparison.title)),
        element("style", Markup(style_sheet())),
    )
    return f"<!DOCTYPE html>\n{element('html', head, element('body', body), lang='en')}\n"


def render_markdown(comparison: Comparison) -> str:
    """The tables of the report as Markdown, to be pasted into a page."""
    numbers = count(1)
    parts = [f"# {markdown_text(comparison.title)}"]
    if comparison.command:
        parts.append(code_block(comparison.command))
    sections = [
        overview_section(comparison),
        *(sequence_section(sequence, None) for sequence in comparison.sequences),
        made_with_section(comparison),
    ]
    for section in sections:
        parts += [f"## {markdown_text(section.heading)}"] if section.heading and section.blocks else []
        parts += [markdown_text(line) for line in section.about]
        parts += [f"> {markdown_text(remark)}" for remark in section.remarks]
        parts += [table_markdown(block, next(numbers)) for block in section.blocks if isinstance(block, Table)]
    return "\n\n".join([*parts, "★ best of its column"]) + "\n"


def _header(comparison: Comparison) -> list[Markup]:
    names = [sequence.sequence for sequence in comparison.sequences]
    links = [
        element("li", element("a", escape(name), href=f"#recording-{number}"))
        for number, name in enumerate(names, start=1)
    ]
    methods = len({method.name for sequence in comparison.sequences for method in sequence.methods})
    counts = f"{_counted(methods, 'method')}, {_counted(len(names), 'recording')}. ★ best of its column."
    command = [element("pre", element("code", escape(comparison.command)))] if comparison.command else []
    navigation = [element("nav", element("ul", *links), aria_label="Recordings")] if len(names) > 1 else []
    return [
        element("h1", escape(comparison.title)), element("p", escape(counts), class_="about"), *command, *navigation
    ]  # fmt: skip


def _sections_html(sections: Sequence[Section], styles: Mapping[str, Style]) -> list[Markup]:
    tables, figures = count(1), count(1)
    parts = []
    for number, section in enumerate(sections):
        heading = [element("h2", escape(section.heading))] if section.heading and section.blocks else []
        about = [element("p", *_lines(section.about), class_="about")] if section.about else []
        remarks = [element("p", escape(remark), class_="remark") for remark in section.remarks]
        blocks = [
            figure_html(block, next(figures)) if isinstance(block, Figure) else table_html(block, next(tables), styles)
            for block in section.blocks
        ]
        parts.append(element("section", *heading, *about, *remarks, *blocks, id=f"recording-{number}"))
    return parts


def _settings_html(comparison: Comparison) -> list[Markup]:
    texts = settings_texts(comparison)
    if not texts:
        return []
    folded = [
        element("details", element("summary", escape(name)), element("pre", element("code", escape(text))))
        for name, text in texts
    ]
    return [element("section", element("h2", escape("Settings")), *folded, id="settings")]


def _lines(texts: Sequence[str]) -> list[Markup]:
    return [join([Markup("<br/>") if number else Markup(""), escape(text)]) for number, text in enumerate(texts)]


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
