"""Imports run one way, downward: reads every import of the package and fails on any other edge."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# A room may import rooms of a lower floor. On the floor of methods are learn, mask and evaluate,
# and any room not named here; these may import each other, without cycles. `checks`, what an
# argument must be, lies below all: every public function asks the same in the same words.
FLOORS = {
    "checks": -1,
    "vision": 0,
    "independence": 0,
    "nets": 0,
    "systems": 1,
    "expert": 2,
    "pipeline": 4,
}
METHODS = 3
# Only the pipeline knows files and screens.
EDGES_OF_THE_WORLD = {"matplotlib", "rich", "orbax", "PIL", "tyro"}
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


def floor(module):
    room = module.split(".")[1]
    return FLOORS.get(room, METHODS)


def forbidden(importer, imported):
    """Why one module of jaxdeconf may not import another module, or None."""
    top, room = imported.split(".")[0], importer.split(".")[1:2]
    if top in ("experiments", "benchmarks", "tests"):
        return "is imported by nobody"
    if imported == ADAPTER:
        return "is an edge: nothing inside imports it"
    if top == "brax" and importer != ADAPTER:
        return f"belongs to {ADAPTER}"
    if top in EDGES_OF_THE_WORLD and room != ["pipeline"]:
        return "belongs to the pipeline"
    if top != "jaxdeconf" or imported == "jaxdeconf" or not room:
        return None
    here, there = floor(importer), floor(imported)
    same = importer.split(".")[1] == imported.split(".")[1] or here == there == METHODS
    return None if there < here or same else "is not below"


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
        ("jaxdeconf.learn.clone", "orbax.checkpoint"),
        ("jaxdeconf.systems.cartpole", "brax.envs"),
        ("jaxdeconf.pipeline.stages", "jaxdeconf.systems.brax_env"),
        ("jaxdeconf.pipeline.run", "experiments.cartpole"),
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


def test_only_the_pipeline_prints_or_writes():
    loud = []
    for name, tree in sources("jaxdeconf").items():
        if name.startswith("jaxdeconf.pipeline"):
            continue
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            function = call.func
            if isinstance(function, ast.Name) and function.id in {"print", "open"}:
                loud.append(f"{name}:{call.lineno} calls {function.id}")
            if isinstance(function, ast.Attribute) and function.attr in WRITERS:
                loud.append(f"{name}:{call.lineno} calls {function.attr}")
    assert not loud, "\n".join(loud)


def test_importing_the_package_is_light():
    """Brax and matplotlib take seconds to import: only who uses them pays."""
    code = "import sys, jaxdeconf; print(sorted({'brax', 'matplotlib'} & sys.modules.keys()))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
