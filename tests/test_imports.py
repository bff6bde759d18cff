"""Imports run one way, downward: reads every import of the package and fails on any other edge."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from jaxdeconf.methods import METHODS

ROOT = Path(__file__).parents[1]
# A room may import rooms of a lower floor; rooms on one floor do not know each other. What is not
# named here lies on the floor of learning: learn, mask, leakage.
FLOORS = {
    **dict.fromkeys(["checks", "keys", "threads", "traced", "version"], 0),
    **dict.fromkeys(["vision", "independence", "nets", "demos"], 1),
    "systems": 2,
    "expert": 3,
    "collect": 4,
    "learn": 4,
    "mask": 4,
    "leakage": 5,
    **dict.fromkeys(["views", "evaluate"], 5),
    **dict.fromkeys(["method", "region"], 6),
    "rivals": 7,
    "methods": 8,
    **dict.fromkeys(["deconfound", "formats"], 9),
    "theory": 10,
    "pipeline": 11,
    "presets": 12,
    "sweep": 12,
    "owndata": 12,
    "report": 13,
    "commands": 14,
}
HARNESS = {"formats", "pipeline", "sweep", "owndata", "report", "commands"}
# Only the harness knows files and screens.
EDGES_OF_THE_WORLD = {"matplotlib", "rich", "PIL", "tyro"}
ADAPTER = "jaxdeconf.systems.brax_env"  # the one module that may import brax; nobody imports it
WRITERS = {"write_text", "write_bytes", "save", "savez", "savez_compressed", "savetxt", "tofile"}


def sources(folder):
    """{module name: its syntax tree} of every Python file under a folder of the repository."""
    modules = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        modules[name] = ast.parse(path.read_text(encoding="utf-8"))
    return modules


def imports(name, tree, modules, is_package):
    """Absolute names of what a module imports, inside functions and for type checkers too."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            home = name.split(".")[: len(name.split(".")) + is_package - node.level]
            base = ".".join([*home, node.module] if node.level and node.module else home)
            base = base if node.level else str(node.module)
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                found.add(whole if whole in modules else base)
    return found


def room(module):
    return module.split(".")[1]


def forbidden(importer, imported):
    """Why one module of jaxdeconf may not import another module, or None."""
    top = imported.split(".")[0]
    if top in ("experiments", "benchmarks", "tests"):
        return "is imported by nobody"
    if imported == ADAPTER:
        return "is an edge: nothing inside imports it"
    if top == "brax" and importer != ADAPTER:
        return f"belongs to {ADAPTER}"
    here = importer.split(".")[1:2]
    if top in EDGES_OF_THE_WORLD and here[0] not in HARNESS:
        return "belongs to the harness"
    if top == "tyro" and here != ["commands"]:
        return "belongs to the commands"
    # The package's own page of names stands above all.
    if top != "jaxdeconf" or imported == "jaxdeconf" or not here:
        return None
    if room(importer) == room(imported):
        return None
    return None if FLOORS[room(imported)] < FLOORS[room(importer)] else "is not below"


def graph():
    modules = sources("jaxdeconf")
    packages = {name for name in modules if (ROOT / name.replace(".", "/")).is_dir()}
    return {name: imports(name, tree, modules, name in packages) for name, tree in modules.items()}


def test_every_edge_runs_downward():
    edges = [(importer, imported) for importer, all_ in graph().items() for imported in all_]
    assert len(edges) > 50
    wrong = [f"{a} imports {b}: {b} {why}" for a, b in edges if (why := forbidden(a, b))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("jaxdeconf.systems.cartpole", "jaxdeconf.learn.fit"),
        ("jaxdeconf.vision.raster", "jaxdeconf.systems"),
        ("jaxdeconf.checks", "jaxdeconf.vision.raster"),
        ("jaxdeconf.nets.vae", "jaxdeconf.pipeline.config"),
        ("jaxdeconf.independence.null", "jaxdeconf.mask"),
        ("jaxdeconf.expert.mpc", "jaxdeconf.evaluate"),
        ("jaxdeconf.learn.fit", "jaxdeconf.pipeline.progress"),
        ("jaxdeconf.mask", "matplotlib.pyplot"),
        ("jaxdeconf.evaluate", "rich"),
        ("jaxdeconf.learn.clone", "PIL.Image"),
        ("jaxdeconf.systems.cartpole", "brax.envs"),
        ("jaxdeconf.pipeline.stages", "jaxdeconf.systems.brax_env"),
        ("jaxdeconf.pipeline.run", "experiments.cartpole"),
        ("jaxdeconf.deconfound", "jaxdeconf.pipeline.store"),
        ("jaxdeconf.methods", "jaxdeconf.deconfound"),
        ("jaxdeconf.pipeline.results", "jaxdeconf.report.run"),
        ("jaxdeconf.sweep.log", "jaxdeconf.report.words"),
        ("jaxdeconf.report.run", "jaxdeconf.commands.run"),
        ("jaxdeconf.report.run", "tyro"),
        ("jaxdeconf.evaluate", "jaxdeconf.methods"),
        ("jaxdeconf.formats.npz", "jaxdeconf.owndata.dataset"),
        ("jaxdeconf.owndata.run", "jaxdeconf.sweep.sweep"),
        ("jaxdeconf.theory.claims", "jaxdeconf.pipeline.stages"),
    ],
)
def test_a_wrong_edge_would_be_seen(importer, imported):
    assert forbidden(importer, imported)


def test_no_cycles():
    edges = graph()
    done, path = set(), []

    def visit(module):
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            path.append(module)
            for imported in sorted(edges[module] & edges.keys()):
                visit(imported)
            done.add(path.pop())

    for module in edges:
        visit(module)
    assert done == edges.keys()


def test_nobody_imports_experiments_or_benchmarks():
    for folder in ("experiments", "benchmarks"):
        modules = sources(folder)
        for name, tree in modules.items():
            tops = {imported.split(".")[0] for imported in imports(name, tree, modules, False)}
            # A benchmark may have a file of its own beside it.
            assert not tops & {"experiments", "benchmarks", "tests"} - {folder}, name


def test_only_the_harness_prints_or_writes():
    loud = []
    for name, tree in sources("jaxdeconf").items():
        if name.count(".") and room(name) in HARNESS:
            continue
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            function = call.func
            if isinstance(function, ast.Name) and function.id in {"print", "open"}:
                loud.append(f"{name}:{call.lineno} calls {function.id}")
            if isinstance(function, ast.Attribute) and function.attr in WRITERS:
                loud.append(f"{name}:{call.lineno} calls {function.attr}")
    assert not loud, "\n".join(loud)


def test_the_page_knows_no_simulator():
    """The workflow on arrays: nothing that it imports, or that those import, moves or is a file."""
    edges = graph()
    seen, left = set(), ["jaxdeconf.deconfound"]
    while left:
        module = left.pop()
        seen.add(module)
        left += [name for name in edges[module] & edges.keys() if name not in seen]
    rooms = {room(module) for module in seen if module.count(".")}
    assert not rooms & {"systems", "expert", "collect", "evaluate", *HARNESS}


def test_only_the_table_names_a_method():
    """Strings in the code; what a docstring or a comment says of one is no dependence on it."""
    named = []
    for name, tree in sources("jaxdeconf").items():
        if name == "jaxdeconf.methods" or name.startswith("jaxdeconf.rivals."):
            continue  # the table, and what is put into it
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in METHODS:
                named.append(f"{name}:{node.lineno} names {node.value}")
    assert not named, "\n".join(named)


def test_importing_the_package_is_light():
    """Brax and matplotlib take seconds to import: only who uses them pays."""
    code = "import sys, jaxdeconf as jd; jd.run; jd.find_mask; print(sorted({}&sys.modules.keys()))"
    heavy = {"brax", "matplotlib", "tyro", "PIL"}
    done = subprocess.run(
        [sys.executable, "-c", code.format(heavy)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"
