"""Who may import whom, read from the syntax trees; every rule is also tried on a planted breach."""

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import pytest

REPOSITORY = Path(__file__).parents[1]
# Folders of the top level that are subpackages of lidarslam by a link beside its other folders.
LINKED = ("odometry", "mapping", "evaluation")

# The longest matching prefix holds: what the modules below it may import of our own.
MAY_IMPORT = {
    "lidarslam.core": ("lidarslam.core",),
    "lidarslam.datasets": ("lidarslam.core", "lidarslam.datasets"),
    "lidarslam.simulation": ("lidarslam.core", "lidarslam.datasets", "lidarslam.simulation"),
    "lidarslam.odometry": ("lidarslam.core", "lidarslam.odometry"),
    "lidarslam.mapping": ("lidarslam.core", "lidarslam.mapping"),
    "lidarslam.evaluation": ("lidarslam.core", "lidarslam.evaluation"),
    "lidarslam": ("lidarslam",),
}
# The way down is cli -> commands -> run -> pipeline -> libraries: nobody looks up it.
RUN = tuple(f"lidarslam.run.{part}" for part in ("run", "request", "results", "checkpoints"))
MAY_NOT_IMPORT = {
    "lidarslam": ("lidarslam.cli", "lidarslam.commands", "lidarslam.api"),
    "lidarslam.pipeline": RUN,
    "lidarslam.viewer": RUN,
    "lidarslam.config": RUN,
}
ENTRY_POINTS = ("lidarslam", "lidarslam.cli", "lidarslam.__main__")
CORE_MAY_IMPORT = {"numpy", "scipy", "typing_extensions", *sys.stdlib_module_names}
# What odometry and mapping both need of a foreign library, and share through the core.
CORE_EXCEPTIONS = {
    "lidarslam.core.compiled": {"numba"},
    "lidarslam.core.tasks": {"ray"},
    "lidarslam.core.json_text": {"pydantic"},
    "lidarslam.core.settings": {"pydantic"},
}
# A foreign library -> the modules that may know it; a trailing * stands for any ending.
CONFINED = {
    "kiss_icp": ("lidarslam.odometry.methods.kiss*",),
    "kiss_slam": ("lidarslam.compare.peers.libraries",),
    "rko_lio": ("lidarslam.compare.peers.libraries",),
    "small_gicp": ("lidarslam.compare.peers.libraries",),
    "gtsam": ("lidarslam.mapping.pose_graph.optimizer", "lidarslam.mapping.inertial.window"),
    "rerun": ("lidarslam.viewer.rerun_*",),
    "click": ("lidarslam.cli", "lidarslam.commands.*"),
    "laspy": ("lidarslam.assessment.inputs", "lidarslam.mapping.global_map.point_cloud"),
    "pye57": ("lidarslam.assessment.inputs", "lidarslam.mapping.global_map.point_cloud"),
    "jinja2": ("lidarslam.evaluation.report.report",),
    "plotly": ("lidarslam.evaluation.report.*",),
    "safetensors": ("lidarslam.odometry.network.checkpoint",),
    "numba": ("lidarslam.core.compiled",),
    "onnx": ("lidarslam.odometry.network.checkpoint",),
    "onnxscript": ("lidarslam.odometry.network.checkpoint",),
    "ouster": ("lidarslam.datasets.packets.ouster*",),
    "velodyne_decoder": ("lidarslam.datasets.packets.velodyne*",),
    "evalio": ("lidarslam.compare.peers.evalio_pipelines", "lidarslam.datasets.published.evalio*"),
    "fsspec": ("lidarslam.datasets.fetched",),
    "pyproj": ("lidarslam.exports.geo",),
    "ray": ("lidarslam.core.tasks",),
    "rosbags": ("lidarslam.datasets.*", "lidarslam.simulation.bag_writer", "lidarslam.exports.*", "lidarslam.live.*"),
    "cyclonedds": ("lidarslam.live.dds", "lidarslam.live.live"),
}
HEAVY = {"torch", "open3d", "scipy", "gtsam", "kiss_icp", "rerun", "rosbags", "matplotlib", "numba"}
MOST_LINES = 500
NAMES_THAT_SAY_NOTHING = {"utils", "util", "common", "base", "helpers", "helper", "misc", "tools"}


class Import(NamedTuple):
    """One import: the module it names, and whether it is carried out when the importing module is loaded."""

    target: str
    on_load: bool


@dataclass(frozen=True)
class Module:
    """One source file."""

    name: str
    tree: ast.Module
    is_package: bool = False
    lines: int = 0


Modules = Mapping[str, Module]


def parse_sources(root: Path) -> dict[str, Module]:
    """Every module of the packages, by its dotted name."""
    modules = {}
    for path in sorted(path for package in ("lidarslam", *LINKED) for path in (root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        parts = ("lidarslam", *parts) if parts[0] in LINKED else parts
        is_package = parts[-1] == "__init__"
        name = ".".join(parts[:-1] if is_package else parts)
        text = path.read_text(encoding="utf-8")
        modules[name] = Module(name, ast.parse(text, str(path)), is_package, text.count("\n"))
    return modules


def parse_planted(sources: Mapping[str, str]) -> dict[str, Module]:
    """Modules from texts, by their dotted names within the program, for planted breaches."""
    names = {f"lidarslam.{name}".rstrip("."): text for name, text in sources.items()}
    packages = {name for name in names if any(other.startswith(f"{name}.") for other in names)}
    return {name: Module(name, ast.parse(text), name in packages, text.count("\n")) for name, text in names.items()}


def below(name: str, prefix: str) -> bool:
    """Whether the dotted name is the prefix or lies below it."""
    return name == prefix or name.startswith(f"{prefix}.")


def imports_of(module: Module, modules: Modules) -> Iterator[Import]:
    """All imports of a module, those inside functions and `import_module("literal")` too."""
    yield from _imports_in(module.tree, module, modules, on_load=True)


def _imports_in(node: ast.AST, module: Module, modules: Modules, on_load: bool) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (Import(alias.name, on_load) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            source = _absolute(child, module)
            for alias in child.names:
                submodule = f"{source}.{alias.name}"
                yield Import(submodule if submodule in modules else source, on_load)
        elif isinstance(child, ast.Call) and _is_import_call(child):
            yield Import(child.args[0].value, on_load)
        else:
            is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from _imports_in(child, module, modules, on_load and not is_function)


def _absolute(statement: ast.ImportFrom, module: Module) -> str:
    if not statement.level:
        return statement.module or ""
    up = statement.level - module.is_package
    parts = module.name.split(".")
    return ".".join([*parts[: len(parts) - up], *([statement.module] if statement.module else [])])


def _is_import_call(call: ast.Call) -> bool:
    function = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if function not in ("import_module", "__import__", "require_library") or not call.args:
        return False
    return isinstance(call.args[0], ast.Constant) and isinstance(call.args[0].value, str)


def is_ours(target: str) -> bool:
    return target.partition(".")[0] == "lidarslam"


def layer_breaches(modules: Modules) -> list[str]:
    """Imports of our own modules that go up or sideways."""
    breaches = []
    for module in modules.values():
        allowed = MAY_IMPORT[max((p for p in MAY_IMPORT if below(module.name, p)), key=len)]
        above = {t for p, targets in MAY_NOT_IMPORT.items() if below(module.name, p) for t in targets}
        for target, _ in imports_of(module, modules):
            beside = {t for t in above if below(module.name, t)}  # of its own package
            upward = module.name not in ENTRY_POINTS and any(below(target, t) for t in above - beside)
            if is_ours(target) and (upward or not any(below(target, prefix) for prefix in allowed)):
                breaches.append(f"{module.name} imports {target}")
    return breaches


def foreign_breaches(modules: Modules) -> list[str]:
    """Foreign libraries outside their file, and in the core any that it must do without."""
    breaches = []
    for module in modules.values():
        for target, _ in imports_of(module, modules):
            library = target.partition(".")[0]
            at_home = any(fnmatchcase(module.name, home) for home in CONFINED.get(library, ("*",)))
            fit_for_core = is_ours(target) or library in CORE_MAY_IMPORT | CORE_EXCEPTIONS.get(module.name, set())
            if not at_home or (below(module.name, "lidarslam.core") and not fit_for_core):
                breaches.append(f"{module.name} imports {library}")
    return breaches


def cycle_breaches(modules: Modules) -> list[str]:
    """Circles of imports, from their alphabetically first module; one at least of every tangle."""
    graph = {
        name: sorted({t for t, _ in imports_of(module, modules) if t in modules and not modules[t].is_package})
        for name, module in modules.items()
    }
    return _circles(graph)


def _circles(graph: Mapping[str, list[str]]) -> list[str]:
    found = {way for name in graph if (way := _shortest_way_back(name, graph)) and min(way) == way[0]}
    return sorted(" -> ".join([*way, way[0]]) for way in found)


def _shortest_way_back(start: str, graph: Mapping[str, list[str]]) -> tuple[str, ...] | None:
    ways, seen = [(start,)], set()
    for way in ways:  # grows while it is walked: breadth first
        for target in graph[way[-1]]:
            if target == start:
                return way
            if target not in seen:
                seen.add(target)
                ways.append((*way, target))
    return None


def weight_breaches(modules: Modules) -> list[str]:
    """Heavy libraries that are loaded with a light module, be it through others of ours."""
    breaches = []
    for light in light_modules(modules):
        reached = [light]
        for name in reached:
            targets = [t for t, on_load in imports_of(modules[name], modules) if on_load]
            breaches += [f"{light} loads {t} through {name}" for t in targets if t.partition(".")[0] in HEAVY]
            reached += sorted({t for t in targets if t in modules and t not in reached})
    return breaches


def light_modules(modules: Modules) -> list[str]:
    """The modules `--help` and loading a configuration need."""
    return [name for name in modules if name.endswith((".config", "lidarslam.cli")) or below(name, "lidarslam.config")]


def root_breaches(modules: Modules) -> list[str]:
    """Package roots that hold anything but a docstring; that of the program may name what it loads when it is used."""
    packages = [module for module in modules.values() if module.is_package]
    return [
        m.name
        for m in packages
        if ast.get_docstring(m.tree) is None
        or not (all(map(_is_lazy, m.tree.body[1:])) if m.name == "lidarslam" else len(m.tree.body) == 1)
    ]


def _is_lazy(statement: ast.stmt) -> bool:
    """Whether a statement loads nothing: names, tables of names, and imports for type checkers or inside functions."""
    if isinstance(statement, ast.ImportFrom):
        return statement.module == "typing"
    if isinstance(statement, ast.Assign):
        return not any(isinstance(node, ast.Call) for node in ast.walk(statement))
    if not isinstance(statement, ast.If):
        return False
    condition = ast.unparse(statement.test)
    functions = all(isinstance(node, ast.FunctionDef) for node in statement.body)
    return not statement.orelse and (condition == "TYPE_CHECKING" or (condition == "not TYPE_CHECKING" and functions))


def name_breaches(modules: Modules) -> list[str]:
    """Modules whose name says nothing about what they hold."""
    return [name for name in modules if name.rpartition(".")[2] in NAMES_THAT_SAY_NOTHING]


def size_breaches(modules: Modules) -> list[str]:
    """Files too long to be read at once."""
    return [f"{module.name} has {module.lines} lines" for module in modules.values() if module.lines > MOST_LINES]


def folder_breaches(modules: Modules) -> list[str]:
    """Parts of one package, files or folders, that import one another in a circle."""
    breaches = []
    for package in (module.name for module in modules.values() if module.is_package):
        beneath = [name for name in modules if name != package and below(name, package)]
        inside = {name: f"{package}.{name.removeprefix(f'{package}.').partition('.')[0]}" for name in beneath}
        graph: dict[str, set[str]] = {part: set() for part in inside.values()}
        for name, part in inside.items():
            graph[part] |= {inside[t] for t, _ in imports_of(modules[name], modules) if t in inside} - {part}
        breaches += _circles({part: sorted(targets) for part, targets in graph.items()})
    return sorted(breaches)


RULES = [layer_breaches, foreign_breaches, cycle_breaches, folder_breaches, weight_breaches, root_breaches]
RULES += [name_breaches, size_breaches]


@pytest.fixture(scope="module")
def sources() -> dict[str, Module]:
    return parse_sources(REPOSITORY)


@pytest.mark.parametrize("rule", RULES)
def test_the_sources_keep_the_rule(rule, sources):
    assert rule(sources) == []


def test_all_sources_are_looked_at(sources):
    assert {"lidarslam", "lidarslam.core", *(f"lidarslam.{package}" for package in LINKED)} <= set(sources)
    assert sources["lidarslam.core"].is_package
    found = set(imports_of(sources["lidarslam.core.trajectory"], sources))
    assert Import("lidarslam.core.geometry", True) in found
    assert len(sources) > 20


def assert_loaded_without(libraries, names):
    code = f"import sys, {', '.join(names)}; print(sorted({libraries!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr


def test_light_modules_load_nothing_heavy(sources):
    """The syntax trees see our own imports only; the interpreter sees those of foreign libraries too."""
    assert_loaded_without(HEAVY, light_modules(sources))


def test_a_run_begins_without_libraries_that_few_runs_need():
    slow = {*(f"scipy.{part}" for part in ("interpolate", "optimize", "sparse", "spatial"))}
    slow |= {"open3d", "torch", "gtsam", "rerun", "evalio"}
    readers = ("lidarslam.datasets.ros.rosbag", "lidarslam.datasets.folders.scan_folder")
    assert_loaded_without(slow, ("lidarslam.run.run", *readers))


@pytest.mark.parametrize(
    ("rule", "planted", "told"),
    [
        (layer_breaches, {"odometry.a": "import lidarslam.mapping.b"}, "odometry.a imports mapping.b"),
        (layer_breaches, {"mapping.mapper": "from lidarslam import run"}, "mapping.mapper imports lidarslam"),
        (layer_breaches, {"run": "def f():\n  from lidarslam.commands.a import say"}, "run imports commands.a"),
        (layer_breaches, {"core": "", "core.x": "from ..datasets import ply"}, "core.x imports datasets"),
        (foreign_breaches, {"core.scan": "def f():\n  import torch.nn"}, "core.scan imports torch"),
        (foreign_breaches, {"mapping.mapper": "import numba"}, "mapping.mapper imports numba"),
        (foreign_breaches, {"run": "class A:\n  import click"}, "run imports click"),
        (foreign_breaches, {"viewer": "lazy = importlib.import_module('rerun.blueprint')"}, "viewer imports rerun"),
        (
            cycle_breaches,
            {"run.a": "import lidarslam.run.b", "run.b": "from .. import x", "x": "def f():\n  from .run import a"},
            "run.a -> run.b -> x -> run.a",
        ),
        (
            weight_breaches,
            {"train.config": "from lidarslam.train import a", "train.a": "try:\n  import torch\nfinally: ..."},
            "train.config loads torch through train.a",
        ),
        (root_breaches, {"mapping": '"""Maps."""\nfrom lidarslam.mapping import a', "mapping.a": ""}, "mapping"),
        (root_breaches, {"": '"""SLAM."""\nif not TYPE_CHECKING:\n  import numpy', "api.slam": ""}, "lidarslam"),
        (name_breaches, {"odometry.utils": ""}, "odometry.utils"),
        (
            folder_breaches,
            {"run": "", "run.b": "", "run.b.x": "import lidarslam.run.a.x", "run.b.y": ""}
            | {"run.a": "", "run.a.x": "", "run.a.y": "import lidarslam.run.b.y"},
            "run.a -> run.b -> run.a",
        ),
        (size_breaches, {"mapping.a": "\n" * 501}, "mapping.a has 501 lines"),
    ],
)
def test_a_planted_breach_is_told(rule, planted, told):
    assert [breach.replace("lidarslam.", "") for breach in rule(parse_planted(planted))] == [told]
