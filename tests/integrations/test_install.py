"""The package as strangers install it: a wheel with all data; reading with hardly anything; rollouts without torch."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

from dmcvb_gen.cli import main
from dmcvb_gen.extras import EXTRAS
from tests.conftest import MAIN, python

ROOT = Path(__file__).parents[2]
READING = ("numpy", "zarr", "numcodecs", "fsspec", "pydantic", "click", "rich", "tqdm", "filelock", "tenacity", "h5py")
"""What one who only reads, fetches and exports to HDF5 installs (each brings what it needs)."""
HEAVY = {"pandas", *(module for modules in EXTRAS.values() for module in modules)}
"""What the core does without."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from the tree."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    return next(folder.glob("dmcvb_gen-*.whl"))


def test_the_pinned_versions_are_for_every_python_3_11():
    """One that wants a later patch than the system's has the installer search without end for another way."""
    pins = (ROOT / "scripts" / "constraints.txt").read_text().splitlines()[1:]
    pinned = {canonicalize_name(name): version for name, _, version in (pin.partition("==") for pin in pins)}
    named = ((found, pinned.get(canonicalize_name(found.metadata["Name"]))) for found in metadata.distributions())
    here = [found for found, version in named if version and Version(found.version).public == version]
    assert len(here) > 100, "the tests' machine is not set up by scripts/setup.sh"
    too_new = {found.name: found.metadata["Requires-Python"] for found in here}
    assert {name: asks for name, asks in too_new.items() if not SpecifierSet(asks or "").contains("3.11.0")} == {}


def test_the_wheel_is_small_and_carries_every_data_file(wheel):
    assert Path(wheel).stat().st_size < 25_000_000
    inside = set(zipfile.ZipFile(wheel).namelist())
    compiled = (".py", ".pyc", ".nbi", ".nbc")
    data = [path for path in (ROOT / "dmcvb_gen").rglob("*") if path.is_file() and path.suffix not in compiled]
    assert len(data) > 30
    assert not [path for path in data if path.relative_to(ROOT).as_posix() not in inside]


def closure(packages):
    """Packages and what they need, of those installed here."""
    found, todo = set(), list(packages)
    while todo:
        name = canonicalize_name(todo.pop())
        if name not in found:
            found.add(name)
            needs = map(Requirement, metadata.requires(name) or ())
            todo += [need.name for need in needs if need.marker is None or need.marker.evaluate({"extra": ""})]
    return found


def site_of(packages, wheel, folder):
    """A folder with nothing but the wheel and links to these packages and what they need."""
    zipfile.ZipFile(wheel).extractall(folder)
    library = Path(sysconfig.get_paths()["purelib"])
    for name in closure(packages):
        for file in metadata.distribution(name).files or ():
            top = file.parts[0]
            if top not in ("..", "__pycache__", "bin") and not (folder / top).exists() and (library / top).exists():
                (folder / top).symlink_to(library / top)
    return folder


def run(site, *arguments):
    """`python -m dmcvb_gen ...` with the packages of `site` alone."""
    code = f"import sys; sys.path = [{str(site)!r}, *(p for p in sys.path if 'site-packages' not in p)]; {MAIN}"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-S", "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=site.parent)


@pytest.mark.slow
def test_reading_needs_next_to_nothing(wheel, small_release, tmp_path):
    site = site_of(READING, wheel, tmp_path / "site")
    assert not (site / "mujoco").exists() and not (site / "torch").exists() and not (site / "gymnasium").exists()
    for command in (
        ["--help"],
        ["info", small_release],
        ["verify", small_release],
        ["publish", small_release, f"file:{tmp_path / 'published'}"],
        ["fetch", f"file:{tmp_path / 'published'}", "--out", tmp_path / "fetched"],
        ["info", f"file:{tmp_path / 'published'}"],
        ["export", small_release, "--to", "hdf5", "--out", tmp_path / "h5"],
    ):
        done = run(site, *command)
        code = 3 if "verify" in command else 0  # bytes alone are checked
        assert done.returncode == code, (command, done.stdout, done.stderr)
    refused = run(site, "rollout", "walker-walk", "--out", tmp_path / "x")
    assert refused.returncode == 2 and "pip install" in refused.stderr and "Traceback" not in refused.stderr


@pytest.mark.slow
def test_the_core_makes_and_shows_data_without_any_extra(tmp_path):
    source = f"""
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {HEAVY!r}:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Missing())
{MAIN}
"""

    def command(*words, code=0):
        return python(source, *words, code=code, cwd=tmp_path)

    small = ["--episodes", "1", "--max-steps", "4", "--size", "16", "--level", "expert"]
    for task in ("walker-walk", "ant-maze-empty7x7"):
        command("rollout", task, *small, "--out", task)
        for name in ("info", "preview", "verify"):
            command(name, task)
        command("view", task, "--out", f"{task}.html")
        assert (tmp_path / task / "preview/preview.webp").exists()
    for name in main.list_commands(None):
        command(name, "--help")
    assert "pip install torch" in command("train-behaviour", "walker-walk", code=2).stderr
