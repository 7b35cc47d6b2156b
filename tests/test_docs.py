"""README and docs: every block of code runs, in the order of its page, and the site builds without a warning."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import pytest

from dmcvb_gen.cli import COMMANDS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r'^```(\w*)(?: title="([^"]+)")?[^\n]*\n(.*?)^```$', re.MULTILINE | re.DOTALL)
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


@pytest.fixture
def bucket(monkeypatch):
    """An S3 server with a bucket named "bucket", as the pages' commands expect one."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    for name, value in {
        "AWS_ENDPOINT_URL": address,
        "AWS_ACCESS_KEY_ID": "docs",
        "AWS_SECRET_ACCESS_KEY": "docs",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    import boto3

    # The server's objects outlive it in this process; each page finds an empty bucket.
    urllib.request.urlopen(urllib.request.Request(f"{address}/moto-api/reset", method="POST")).close()
    boto3.client("s3").create_bucket(Bucket="bucket")
    yield address
    urllib.request.urlopen(urllib.request.Request(f"{address}/moto-api/reset", method="POST")).close()
    server.stop()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_of_a_page_runs(page, tmp_path, bucket):
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    for block in blocks(page):
        if block.language not in RUN or block.file:  # files have tests of their own
            continue
        start = ["bash", "-euo", "pipefail", "-c"] if block.language == "bash" else [sys.executable, "-c"]
        done = subprocess.run([*start, block.code], cwd=tmp_path, env=environment, capture_output=True, text=True)
        told = f"{page.name}:{block.line}\n{block.code}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        assert done.returncode == 0, told


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_does_not_run_is_set_up_or_layout(page):
    for block in blocks(page):
        assert block.language in RUN | SHOWN, f"{page.name}:{block.line}: {block.language}"
        if block.language == "console":
            commands = [line for line in block.code.splitlines() if line.strip() and not line.startswith("#")]
            assert all(line.startswith(SET_UP) for line in commands), f"{page.name}:{block.line}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_file_that_a_page_shows_is_the_one_in_the_repository(page):
    for block in blocks(page):
        if block.file:
            assert block.code == (ROOT / block.file).read_text(), f"{page.name}:{block.line}: copy {block.file}"


def test_the_pages_show_every_example():
    shown = {block.file for page in PAGES for block in blocks(page) if block.file}
    assert shown == {str(path.relative_to(ROOT)) for path in (ROOT / "docs/examples").rglob("*.py")}


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_shows_every_command(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    site = tmp_path / "site"
    pages = {path.parent.name: path.read_text() for path in (site / "cli").rglob("index.html")}
    assert set(COMMANDS) <= set(pages)
    assert not any("Sentinel" in page or "UNSET" in page for page in pages.values())
    assert re.search(r"<code>[^<]*dmcvb-gen view releases/demo\n[^<]*dmcvb-gen view", pages["view"])  # lines are kept
    assert "hdf5" in (site / "exports/index.html").read_text().split("leaves out")[1]
    assert "max_steps" in (site / "reading/index.html").read_text()  # of the environments


def test_links_and_pictures_are_there_where_the_site_is_not_built():
    """Who reads the pages in the repository finds all but the commands' own pages, which are made of the code."""
    cards = [ROOT / "dataset_cards/README.md"]
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", *cards]:
        targets = re.findall(r"!?\[[^\]]*\]\(([^)\s#]+)", BLOCK.sub("", page.read_text()))
        made = [target for target in targets if target.startswith(("http", "cli/"))]
        for target in set(targets) - set(made):
            assert (page.parent / target).exists(), f"{page.name} shows {target}"
