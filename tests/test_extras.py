"""One table says which extra brings a module that is missing: every import of another package is in it."""

import importlib.metadata
import re
import sys
import tomllib
from pathlib import Path

import pytest

from dmcvb_gen.extras import EXTRAS, SIMULATOR, install_hint
from tests.test_house import imported

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LIBRARIES_OF = importlib.metadata.packages_distributions()
"""Module -> the distributions that bring it."""


def imported_modules() -> set[str]:
    """Top modules of other packages that some module of the package imports, at its top or within a function."""
    found = {name.split(".")[0] for path in (ROOT / "dmcvb_gen").rglob("*.py") for name in imported(path)}
    return found - set(sys.stdlib_module_names) - {"dmcvb_gen", "__future__"}


def distributions(requirements: list[str]) -> set[str]:
    return {re.match(r"[\w.-]+", text)[0].lower().replace("_", "-") for text in requirements}


def brought_by(module: str) -> set[str]:
    return {name.lower().replace("_", "-") for name in LIBRARIES_OF.get(module, [module])}


CORE = distributions(PROJECT["dependencies"])


@pytest.mark.parametrize("module", sorted(imported_modules()))
def test_every_import_is_a_dependency_or_its_absence_names_the_cure(module):
    if brought_by(module) & CORE and module not in SIMULATOR:
        return
    advice = install_hint(module)
    assert advice, f"{module} is imported, but its absence has no hint in dmcvb_gen/extras.py"
    if extra := re.search(r"the extra \[(\w+)\]", advice):
        there = distributions(PROJECT["optional-dependencies"][extra[1]])
        assert brought_by(module) & there, f"the extra [{extra[1]}] does not bring {module}"


def test_every_extra_of_the_table_is_one_of_the_project():
    assert set(EXTRAS) <= set(PROJECT["optional-dependencies"])
