"""The page of one run: as a report of one method, with a picture of its map and what is known of each scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from lidarslam.evaluation.comparison.comparison import SequenceComparison
from lidarslam.evaluation.report.figures.figure import method_styles
from lidarslam.evaluation.report.report import render_page, sequence_blocks


@dataclass(frozen=True, eq=False)
class RunPage:
    """Everything the page of a run is made of."""

    title: str
    about: Sequence[str]  # lines below the title
    sequence: SequenceComparison  # the recording with one method, the run
    picture: str | None  # of map and trajectory, a PNG file in base64
    caption: str = ""  # of the picture
    warnings: Sequence[str] = ()
    summary: Mapping[str, str] = field(default_factory=dict)  # quantity -> text
    changed: Mapping[str, str] | None = None  # settings that differ from the defaults; None: unknown
    settings: str = ""  # all of them as YAML


def render_run(page: RunPage) -> str:
    """The page, which fetches nothing and runs no script but its own; see `render_page`."""
    styles = method_styles(method.name for method in page.sequence.methods)
    blocks = list(sequence_blocks(page.sequence, styles))
    return render_page("run.html.j2", page.title, styles, blocks, page=page, content_blocks=blocks)
