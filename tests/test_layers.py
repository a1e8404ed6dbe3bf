"""The layers of the house, and which third-party package may be imported where."""

import ast
import graphlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# The rooms of the application, and the few files beside them: each may use itself and those before.
ROOMS = ["envs", "algos", "version", "errors", "files", "machine", "statistics", "style", "terminal"]
ROOMS += ["runs", "scripted", "pictures", "placement", "import_hand", "study", "commands", "api"]
ROOMS += ["", "__main__"]
ALLOWED = {
    "mujoco": ("envs/simulators/", "envs/hands/", "tactilerl/import_hand.py"),
    "pybullet": ("envs/simulators/pybullet.py",),
    "mpi4py": ("algos/mpi.py",),
    "dask": ("tactilerl/study/jobs.py",),
    "matplotlib": ("benchmarks/", "tactilerl/study/figures.py"),
    "torch": (
        *("algos/", "tactilerl/", "benchmarks/"),
        *("envs/batch.py", "envs/simulators/batch.py", "envs/simulators/warp.py"),
    ),
    "mujoco_warp": ("envs/simulators/warp.py",),
    "warp": ("envs/simulators/warp.py",),
    "onnx": ("tactilerl/commands/export.py",),
    "tyro": ("tactilerl/terminal/", "tactilerl/commands/"),
}


@cache
def nodes(path):
    """All imports in a file, at any depth of it."""
    walked = ast.walk(ast.parse(path.read_text()))
    return [node for node in walked if isinstance(node, ast.Import | ast.ImportFrom)]


def imports(path):
    """(level, module) of every import in a file."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        else:
            yield node.level, node.module or ""


def sources(*folders):
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def test_envs_and_algos_import_neither_each_other_nor_the_application():
    for path in sources("envs", "algos"):
        depth = len(path.relative_to(ROOT).parts) - 1
        for level, module in imports(path):
            assert not module.startswith("tactilerl"), f"{path}: imports {module}"
            assert level <= depth, f"{path}: reaches out of its layer"


def modules_of(package):
    """Modules of a package by name, and the names of those that each imports, for types too."""
    files = [path.relative_to(ROOT) for path in sources(package)]
    named = {".".join(p.with_suffix("").parts).removesuffix(".__init__"): p for p in files}
    return {name: {*_imported(path, named)} - {name} for name, path in named.items()}


def _imported(path, named):
    for node in nodes(ROOT / path):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = ".".join([*path.parts[: -node.level], *filter(None, [node.module])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in named or room(full) in ("envs", "algos") else base


def room(module):
    return f"{module}..".split(".")[1]


def test_rooms_use_only_those_below_them():
    for module, imported in modules_of("tactilerl").items():
        for other in imported:
            above = ROOMS.index(room(other)) > ROOMS.index(room(module))
            assert not above, f"{module} imports {other}"


def test_no_module_imports_itself_by_way_of_others():
    for package in ("tactilerl", "envs", "algos"):
        graphlib.TopologicalSorter(modules_of(package)).prepare()


def test_third_party_packages_stay_where_they_belong():
    for path in sources("envs", "algos", "tactilerl"):
        name = path.relative_to(ROOT).as_posix()
        for level, module in imports(path):
            top = module.partition(".")[0]
            if level == 0 and top in ALLOWED:
                assert name.startswith(ALLOWED[top]), f"{name} imports {top}"


def test_ppo_is_read_in_six_files():
    modules, seen, todo = modules_of("algos"), set(), {"algos.ppo"}
    while todo:
        seen |= todo
        todo = set().union(*(modules[name] for name in todo)) & modules.keys() - seen
    assert len(seen - {"algos"}) <= 6, seen
