"""README and docs: pages and notebook run as a reader runs them, and the site builds without a warning.

Pages run in the order of the site, in one folder, with one bucket. A single page runs too: `-k light`.
"""

import os
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from dmcvb_gen.cli import COMMANDS
from dmcvb_gen.generate.shipped import load_shipped
from dmcvb_gen.version import __version__
from tests.web_server import serving_s3

ROOT = Path(__file__).parent.parent
SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
NAMES = [name for section in SITE["nav"] for names in section.values() for name in names]
MADE = {"index.md": ROOT / "README.md", "cli/index.md": None}
"""Pages of the site that are made -> the file that they are made from."""
PAGES = [page for name in NAMES if (page := MADE.get(name, ROOT / "docs" / name))]
BLOCK = re.compile(r'^```(\w*)(?: title="([^"]+)")?[^\n]*\n(.*?)^```$', re.MULTILINE | re.DOTALL)
SNIPPET = '--8<-- "{}"\n'
RUN = {"bash", "python"}
SHOWN = {"text", "yaml", "toml", "console", ""}
"""What is not run: layouts and formulas, and set-up that needs another machine (console)."""
SET_UP = ("pip install ", "bash scripts/", ". .venv/", "uvx ", "sbatch ", "ray ", "python -m venv ", "apt-get install ")


@dataclass(frozen=True)
class Block:
    """A block of code; `file` if it shows a whole one."""

    language: str
    file: str | None
    code: str
    line: int


def blocks(page: Path) -> list[Block]:
    text = page.read_text()
    return [Block(*found.groups(), text[: found.start()].count("\n") + 1) for found in BLOCK.finditer(text)]


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """A reader's folder and environment, with an S3 server that has a bucket named "bucket"."""
    folder, path = tmp_path_factory.mktemp("reader"), f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with serving_s3("bucket") as options:
        login = {"AWS_ACCESS_KEY_ID": options["key"], "AWS_SECRET_ACCESS_KEY": options["secret"]}
        places = {"AWS_ENDPOINT_URL": options["endpoint_url"], "PATH": path, "XDG_CACHE_HOME": str(folder / "cache")}
        yield folder, os.environ | login | places | {"AWS_DEFAULT_REGION": "us-east-1"}


@pytest.mark.full
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_of_a_page_runs_after_the_pages_before_it(page, reader):
    folder, environment = reader
    for block in blocks(page):
        if block.language not in RUN or block.file:  # files have tests of their own
            continue
        start = ["bash", "-euo", "pipefail", "-c"] if block.language == "bash" else [sys.executable, "-c"]
        done = subprocess.run([*start, block.code], cwd=folder, env=environment, capture_output=True, text=True)
        told = f"{page.name}:{block.line}\n{block.code}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        assert done.returncode == 0, told


@pytest.mark.full
def test_the_notebook_runs_and_its_cloned_policy_beats_the_random_one(tmp_path, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = nbformat.read(ROOT / "docs/examples/tour.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "the notebook is stored without outputs"
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    del sys.modules["ipykernel"]  # where it is loaded, bars of progress take this process for a notebook
    printed = "".join(out.get("text", "") for cell in notebook.cells for out in cell.get("outputs", []))
    assert (tmp_path / "releases/tour/preview/viewer.html").is_file()
    returns = {name: float(value) for name, value in re.findall(r"^(\w+): return (-?\d+)", printed, re.MULTILINE)}
    assert returns["cloned"] > 2 * returns["random"] > 0, printed
    pictures = [out for cell in notebook.cells for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
    assert len(pictures) == 1


def test_every_page_is_in_the_site():
    assert {page.stem for page in PAGES} == {"README", *(path.stem for path in (ROOT / "docs").glob("*.md"))}


def test_pages_stay_short():
    """A tired reader finishes them: 1,500 words a page, but for the tables of results. Bars of tables are no words."""
    long = {page.name: len(re.findall(r"\S*\w\S*", page.read_text())) for page in PAGES if page.stem != "results"}
    assert {name: words for name, words in long.items() if words > 1500} == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_layouts_set_up_and_files_of_the_repository_beside_what_it_runs(page):
    for block in blocks(page):
        where = f"{page.name}:{block.line}"
        assert block.language in RUN | SHOWN, where
        if block.language == "console":
            commands = [line for line in block.code.splitlines() if line.strip() and not line.startswith("#")]
            assert all(line.startswith(SET_UP) for line in commands), where
        if block.file:
            assert block.code == SNIPPET.format(block.file) and (ROOT / block.file).is_file(), where


def test_the_pages_show_every_example_which_is_short():
    shown = {block.file for page in PAGES for block in blocks(page) if block.file}
    assert shown == {str(path.relative_to(ROOT)) for path in (ROOT / "docs/examples").rglob("*.py")}
    lines = {name: len((ROOT / name).read_text().splitlines()) for name in shown}
    assert not [name for name in shown if lines[name] > (30 if "/extending/" in name else 55)]


@pytest.mark.full
def test_the_site_builds_without_a_warning_and_shows_every_command(tmp_path):
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert not [path for path in site.rglob("*") if path.stat().st_size > 2_000_000]
    assert "class LinearBC" in re.sub("<[^>]+>", "", (site / "extending/index.html").read_text())  # files are included
    pages = {path.parent.name: path.read_text() for path in (site / "cli").rglob("index.html")}
    assert set(COMMANDS) <= set(pages)
    assert not any("Sentinel" in page or "UNSET" in page for page in pages.values())
    assert re.search(r"<code>[^<]*dmcvb-gen view releases/demo\n[^<]*dmcvb-gen view", pages["view"])  # lines are kept
    assert "hdf5" in (site / "exports/index.html").read_text().split("leaves out")[1]
    assert "max_steps" in (site / "reading/index.html").read_text()  # of the environments


def test_links_and_pictures_work_in_the_repository():
    """Readers of the repository find all but the commands' own pages, which are made of the code."""
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "dataset_cards/README.md"]:
        targets = re.findall(r"!?\[[^\]]*\]\(([^)\s#]+)", BLOCK.sub("", page.read_text()))
        made = [target for target in targets if target.startswith(("http", "cli/"))]
        for target in set(targets) - set(made):
            assert (page.parent / target).exists(), f"{page.name} shows {target}"


def test_the_citation_has_the_project_s_own_facts():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (cited["version"], cited["license"]) == (__version__, project["license"])
    assert cited["repository-code"] == project["urls"]["Repository"]
    assert cited["preferred-citation"]["url"] == project["urls"]["Paper"]
    digest = load_shipped("dmcvb-v1").digest
    assert digest in (ROOT / "README.md").read_text()
    assert f"sha256:{digest}" in [identifier["value"] for identifier in cited["identifiers"]]
