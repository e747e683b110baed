"""Hooks of mkdocs: mathematics becomes MathML, and links that leave docs/ lead to the repository."""

import re
import tomllib
from html import unescape
from pathlib import Path, PurePosixPath
from posixpath import normpath
from typing import Any

from latex2mathml.converter import convert

REPOSITORY = Path(__file__).parents[1]
_LINK = re.compile(r"\]\((\.\./[^)]+)\)")
_MATH = re.compile(r'<(?:span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</(?:span|div)>', re.DOTALL)


def _url() -> str:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return str(project["urls"]["Homepage"])


def on_config(config: Any) -> Any:
    """The repository's address, which stands in pyproject.toml alone."""
    config.extra["social"] = [{"icon": "fontawesome/brands/git-alt", "link": _url(), "name": "repository"}]
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files outside docs/, which the site does not have."""
    folder = PurePosixPath("docs", page.file.src_uri).parent

    def absolute(link: re.Match[str]) -> str:
        target = normpath(str(folder / link[1]))
        return link[0] if target.startswith("docs/") else f"]({_url()}/blob/main/{target})"

    return _LINK.sub(absolute, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """TeX, as arithmatex leaves it, becomes MathML, which browsers show without a script."""
    return _MATH.sub(_math_ml, html)


def _math_ml(tex: re.Match[str]) -> str:
    if tex[1] == "(":
        return convert(unescape(tex[2]))
    return f'<div class="math">{convert(unescape(tex[2]), display="block")}</div>'
