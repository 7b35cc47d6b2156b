"""The house: imports point down alone, without a circle."""

import ast
import graphlib
from pathlib import Path

import pytest

import dmcvb_gen
from tests.conftest import python

ROOT = Path(dmcvb_gen.__file__).parent
FLOORS = ("tasks", "storage", "dataset", "rendering", "distractors", "policies", "training", "agents", "generate")
FLOORS += ("loaders", "making", "release", "benchmarks", "cli")
"""From the bottom up; all else is the ground. A module imports from its own floor and those below."""
NEVER = {("dataset", "tasks"), ("policies", "rendering"), ("agents", "training")}
"""Floors that do not know each other, although one is above the other."""


def modules() -> dict[str, Path]:
    """Module name -> file, of the whole package."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path) -> set[str]:
    """Full names of what a file imports, anywhere in it, for type checkers too."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def arrows() -> dict[str, set[str]]:
    """Module of the package -> its other modules that it imports."""
    known = modules()

    def module_of(name: str) -> str:
        return name if name in known else name.rpartition(".")[0]

    return {name: known.keys() & set(map(module_of, imported(path))) - {name} for name, path in known.items()}


def floor_of(name: str) -> str:
    """The first part of a module's name; the package itself, which is the front door, is on top of the last one."""
    return "cli" if name in ("dmcvb_gen", "dmcvb_gen.__main__") else name.split(".")[1]


def test_arrows_point_down():
    height = {floor: number for number, floor in enumerate(FLOORS, 1)}
    wrong = set()
    for name, others in arrows().items():
        for other in others:
            floor, below = floor_of(name), floor_of(other)
            if height.get(below, 0) > height.get(floor, 0) or (floor, below) in NEVER:
                wrong.add(f"{name} imports {other}")
    assert not wrong, "\n".join(sorted(wrong))


def test_there_is_no_circle():
    graphlib.TopologicalSorter(arrows()).prepare()  # or says which modules form one


def test_the_architecture_names_every_package_and_no_other():
    text = (ROOT.parent / "docs" / "architecture.md").read_text()
    table = text.split("```text")[1].split("```")[0]
    named = {line.split()[0] for line in table.splitlines() if line}
    assert named == {path.parent.name for path in ROOT.glob("*/__init__.py")}


LIGHT = [
    ("import dmcvb_gen.dataset.writer, dmcvb_gen.spec", ("mujoco", "torch")),
    ("main(['list'])", ("numba", "scipy", "torch", "zarr", "xarray", "matplotlib")),
    ("main(['info', RELEASE])", ("numba", "scipy", "torch", "mujoco", "dm_control", "xarray", "matplotlib")),
    ("main(['--help'])", ("numpy", "rich", "pydantic", "zarr", "mujoco")),
]


@pytest.mark.parametrize("statement, heavy", LIGHT)
def test_what_reads_and_shows_loads_no_simulator(statement, heavy, small_release):
    code = f"""import functools, sys
from dmcvb_gen import cli
main, RELEASE = functools.partial(cli.main, standalone_mode=False), {str(small_release)!r}
{statement}
print("loaded:", [name for name in {heavy!r} if name in sys.modules])"""
    assert python(code).stdout.splitlines()[-1] == "loaded: []"


def test_tests_lie_in_folders_named_after_packages():
    others = {"faults", "golden", "integrations", "long", "__pycache__"}
    folders = {path.name for path in Path(__file__).parent.iterdir() if path.is_dir()} - others
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert folders == packages
