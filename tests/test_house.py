"""The house: every module can be imported, and imports point down alone, without a circle."""

from __future__ import annotations

import ast
import graphlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import dmcvb_gen

ROOT = Path(dmcvb_gen.__file__).parent
FLOORS = (
    (
        "version",
        "spec",
        "text",
        "seeding",
        "extras",
        "errors",
        "files",
        "parallel",
        "distractor_state",
        "arithmetic",
        "precision",
        "compilation",
        "kept",
        "progress",
        "options",
        "own_code",
        "registry",
        "state_file",
    ),  # the ground
    ("tasks",),
    ("storage",),
    ("dataset",),
    ("rendering",),
    ("distractors",),
    ("policies",),
    ("training", "agents"),
    ("generate",),
    ("loaders",),
    ("making",),
    ("release",),
    ("benchmarks",),
    ("cli",),
)
"""From the ground up; a module may import from its own floor (its own package there) and those below."""
NEVER = {("dataset", "tasks"), ("policies", "rendering"), ("agents", "training")}
"""Floors that do not know each other, although one is above the other."""


def modules() -> dict[str, Path]:
    """Module name -> file, of the whole package."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the package that a module imports, anywhere in it, for type checkers too."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} has a relative import"
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                found.add(inside if inside in known else node.module)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text()))
    return {other for other in found if other in known} - {name}


def floor_of(name: str) -> tuple[int, str]:
    """(height, floor) of a module; the package itself, which is the front door, is the roof."""
    inside = name.removeprefix("dmcvb_gen").lstrip(".")
    for height, floor in enumerate(FLOORS):
        for room in floor:
            if inside == room or inside.startswith(f"{room}."):
                return height, room
    assert inside in ("", "__main__"), f"{name} has no place in the house; see DESIGN.md"
    return len(FLOORS), inside


def arrows() -> dict[str, set[str]]:
    known = modules()
    return {name: imports_of(name, path, known) for name, path in known.items()}


def test_every_module_can_be_imported():
    for name in modules():
        if name != "dmcvb_gen.__main__":  # which runs the command
            importlib.import_module(name)


def test_arrows_point_down():
    wrong = set()
    for name, others in arrows().items():
        height, floor = floor_of(name)
        for other in others:
            below, other_floor = floor_of(other)
            beside = below == height and floor != other_floor and height > 0
            if below > height or beside or (floor, other_floor) in NEVER:
                wrong.add(f"{name} imports {other}")
    assert not wrong, "\n".join(sorted(wrong))


def test_there_is_no_circle():
    graphlib.TopologicalSorter(arrows()).prepare()  # or says which modules form one


def test_reading_a_store_needs_no_simulator():
    code = "import sys, dmcvb_gen.dataset, dmcvb_gen.spec; print([m for m in ('mujoco', 'torch') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_the_architecture_names_every_package_and_no_other():
    text = (ROOT.parent / "docs" / "architecture.md").read_text()
    table = text.split("```text")[1].split("```")[0]
    named = {line.split()[0] for line in table.splitlines() if line}
    assert named == {path.parent.name for path in ROOT.glob("*/__init__.py")}


@pytest.mark.parametrize(
    ("command", "heavy"),
    [
        (["list"], ("numba", "scipy", "torch", "zarr", "xarray", "matplotlib")),
        (["info", "RELEASE"], ("numba", "scipy", "torch", "mujoco", "dm_control", "xarray", "matplotlib")),
        (["--help"], ("numpy", "rich", "pydantic", "zarr", "mujoco")),
    ],
    ids=lambda value: value[0],
)
def test_a_command_that_shows_loads_no_simulator(command, heavy, small_release):
    words = [str(small_release) if word == "RELEASE" else word for word in command]
    code = f"""import sys
import pytest

from dmcvb_gen.cli import main
main({words!r}, standalone_mode=False)
print("loaded:", [name for name in {heavy!r} if name in sys.modules])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "loaded: []", done.stdout + done.stderr


def test_tests_lie_in_folders_named_after_packages():
    others = {"faults", "golden", "integrations", "long", "__pycache__"}
    folders = {path.name for path in Path(__file__).parent.iterdir() if path.is_dir()} - others
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert folders == packages
