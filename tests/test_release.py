"""What a release is made of: its version everywhere, the checks on other machines, and the images."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
TARGETS = set(re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE))


WORKFLOWS = [yaml.safe_load(path.read_text()) for path in sorted((REPOSITORY / ".github/workflows").glob("*.yml"))]
JOBS = [job for workflow in WORKFLOWS for job in workflow["jobs"].values()]
CITATION = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())


def test_the_version_is_the_same_everywhere():
    heading = f"## [{PROJECT['version']}] - {CITATION['date-released']}"
    lines = (REPOSITORY / "CHANGELOG.md").read_text().splitlines()
    assert CITATION["version"] == PROJECT["version"]
    assert f"<version>{PROJECT['version']}</version>" in (REPOSITORY / "ros2/package.xml").read_text()
    assert [line for line in lines if line.startswith("## ")][:2] == ["## [Unreleased]", heading]


def test_the_citation_describes_the_project():
    assert CITATION["authors"] == PROJECT["authors"]
    assert CITATION["license"] == PROJECT["license"]
    assert CITATION["repository-code"] == PROJECT["urls"]["Homepage"]
    assert [work["title"].split(":")[0] for work in CITATION["references"][1:]] == ["LOAM", "KISS-ICP"]


def test_workflows_call_the_commands_of_the_makefile():
    steps = [step for job in JOBS for step in job["steps"]]
    commands = [step["run"] for step in steps if "run" in step]
    assert sorted(commands) == ["make lint", "make lowest", "make release", "make test", "make test-long"]
    assert {command.removeprefix("make ") for command in commands} <= TARGETS
    assert all(re.fullmatch(r"actions/[a-z-]+@v\d+", step["uses"]) for step in steps if "uses" in step)


def test_workflows_try_the_python_versions_of_the_classifiers():
    classified = [name.rpartition(" ")[2] for name in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", name)]
    matrices = [job["strategy"]["matrix"]["python"] for job in JOBS if "strategy" in job]
    assert matrices == [classified, classified]
    assert PROJECT["requires-python"] == f">={classified[0]}"


def test_hooks_before_commits_are_those_of_make_lint():
    (repository,) = yaml.safe_load((REPOSITORY / ".pre-commit-config.yaml").read_text())["repos"]
    programs = [hook["entry"].split(" --")[0].removeprefix(".venv/bin/") for hook in repository["hooks"]]
    lint = re.findall(r"^\t\$\(BIN\)/(ruff \w+|mypy)", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    assert programs == lint == ["ruff check", "ruff format", "mypy"]


def test_the_image_is_built_of_files_that_its_context_holds():
    instructions = [line.split() for line in (REPOSITORY / "Dockerfile").read_text().splitlines() if line]
    assert [words[3] for words in instructions if words[0] == "FROM"] == ["wheel", "base", "peers"]
    context = [line[1:] for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert all((REPOSITORY / name).exists() for name in context)
    linked = [path.resolve().name for path in (REPOSITORY / "lidarslam").iterdir() if path.is_symlink()]
    copied = [name for words in instructions if words[0] == "COPY" and words[1] != "." for name in words[1:-1]]
    assert set(linked) | {name for name in copied if not name.startswith(("--from", "/"))} <= set(context)
    assert [words[1] for words in instructions if words[0] == "USER"][-1] != "0"
    assert "peers" in PROJECT["optional-dependencies"]


@pytest.mark.parametrize("page", sorted(REPOSITORY.glob("docs/**/*.md")), ids=lambda page: page.stem)
def test_pages_name_no_package_index(page):
    """Until there is a release on an index, only the extras of an installed lidarslam go by its name."""
    assert not re.search(r"pip install '?lidarslam(?!\[|-\d)", page.read_text())
