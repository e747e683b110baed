"""The report of a comparison and the page of one run: pages that open offline, and the tables as Markdown."""

import re
from base64 import b64encode
from collections.abc import Iterator, Sequence
from hashlib import sha256
from importlib.resources import files
from itertools import groupby

from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from lidarslam.evaluation.comparison.comparison import Comparison, SequenceComparison, Table, number_text, printable
from lidarslam.evaluation.report import accuracy, execution
from lidarslam.evaluation.report.figure import Figure, Styles, method_styles
from lidarslam.evaluation.report.tables import sequence_tables

_TEMPLATES = "templates"
_MARKDOWN_SPECIAL = re.compile(r"([\\`*_\[\]|~#$])")
_HTML_SPECIAL = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;"})


def render_html(comparison: Comparison) -> str:
    """The report as one page; see `render_page`."""
    styles = method_styles(method.name for sequence in comparison.sequences for method in sequence.methods)
    sections = [(sequence, list(sequence_blocks(sequence, styles))) for sequence in comparison.sequences]
    return render_page(
        "report.html.j2",
        comparison.title,
        styles,
        [block for _, blocks in sections for block in blocks],
        comparison=comparison,
        sections=sections,
        settings=_settings(comparison),
    )


def render_page(template: str, title: str, styles: Styles, blocks: Sequence[Table | Figure], **content: object) -> str:
    """A page that fetches nothing and runs no script but its own two, which it holds if it has a figure.

    Text is escaped by Jinja2, data of figures by plotly; the content security policy names both scripts by their hash,
    so that no other can run.
    """
    has_figures = any(isinstance(block, Figure) for block in blocks)
    scripts = [get_plotlyjs(), _file("report.js")] if has_figures else []
    return (
        _environment()
        .get_template(template)
        .render(
            title=title,
            styles=styles,
            style_sheet=_file("report.css"),
            scripts=scripts,
            hashes=[b64encode(sha256(script.encode()).digest()).decode() for script in scripts],
            **content,
        )
    )


def render_markdown(comparison: Comparison) -> str:
    """The tables of the report as Markdown."""
    sections = [
        (sequence, [table for tables in sequence_tables(sequence).values() for table in tables])
        for sequence in comparison.sequences
    ]
    template = _environment().get_template("report.md.j2")
    return template.render(comparison=comparison, sections=sections)


def sequence_blocks(sequence: SequenceComparison, styles: Styles) -> Iterator[Table | Figure]:
    """Tables and figures of a recording, as far as there are values for them."""
    tables = sequence_tables(sequence)
    order: list[Table | Figure | None] = [
        *tables["summary"],
        accuracy.trajectory_figure(sequence, styles),
        accuracy.error_figure(sequence, styles),
        accuracy.deviation_figure(sequence, styles),
        *accuracy.drift_figures(sequence, styles),
        *tables["drift"],
        accuracy.map_figure(sequence),
        *tables["map"],
        execution.scan_figure(sequence, styles),
        *tables["time"],
        *tables["tracking"],
    ]
    return (block for block in order if block is not None)


def _settings(comparison: Comparison) -> list[tuple[str, str]]:
    """Each different configuration, under the method and the recordings it was used for."""
    used: dict[tuple[str, str], list[str]] = {}
    for sequence in comparison.sequences:
        for method in sequence.methods:
            if method.settings:
                used.setdefault((method.name, method.settings), []).append(sequence.sequence)
    return [(f"{name} ({', '.join(sequences)})", text) for (name, text), sequences in used.items()]


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("lidarslam.evaluation.report", _TEMPLATES),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),  # noqa: S701 # not Markdown
        finalize=lambda value: printable(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "markdown": _markdown,
        "fence": _fence,
        "number": number_text,
        "heading_spans": _heading_spans,
    }
    environment.tests["table"] = lambda block: isinstance(block, Table)
    return environment


def _heading_spans(table: Table) -> list[tuple[str, int]]:
    return [(heading, len(list(columns))) for heading, columns in groupby(table.columns, lambda column: column.heading)]


def _markdown(text: str) -> str:
    return _MARKDOWN_SPECIAL.sub(r"\\\1", " ".join(text.split()).translate(_HTML_SPECIAL))


def _fence(text: str) -> str:
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"{fence}\n{text}\n{fence}"


def _file(name: str) -> str:
    return (files("lidarslam.evaluation.report") / _TEMPLATES / name).read_text(encoding="utf-8")


def render_run(title: str, sequence: SequenceComparison, **content: object) -> str:
    """The page of a run, of a recording with one method; see `render_page`."""
    styles = method_styles(method.name for method in sequence.methods)
    blocks = list(sequence_blocks(sequence, styles))
    return render_page("run.html.j2", title, styles, blocks, blocks_shown=blocks, **content)
