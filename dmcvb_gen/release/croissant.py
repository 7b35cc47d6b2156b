"""A release in, its Croissant metadata out (mlcommons.org/croissant, version 1.1, with its RAI terms)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset import Release
from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.dataset.writer import sha256_file, subset_path
from dmcvb_gen.release.episode_table import COLUMNS, PICTURE, TABLE
from dmcvb_gen.release.templates import fill
from dmcvb_gen.storage.hub import on_the_hub, parse_hub_url
from dmcvb_gen.storage.remote import public

HOME = "https://arxiv.org/abs/2409.18330"
"""The page of the benchmark that releases follow."""
TYPES = {"string": "sc:Text", "bool": "sc:Boolean", "double": "sc:Float", str(PICTURE): "sc:ImageObject"}
"""Types of the table of episodes that are no integers."""
FIELDS = {
    "name": ("sc:Text", "task/level/distractor, the subset's folder without .zarr"),
    "task": ("sc:Text", "what is done"),
    "level": ("sc:Text", "skill of the behaviour policies"),
    "setting": ("sc:Text", "distractors or goals"),
    "episodes": ("sc:Integer", "episodes here"),
    "steps": ("sc:Integer", "transitions here"),
    "bytes": ("sc:Integer", "bytes of all shards"),
    "return_mean": ("sc:Float", "mean episode return"),
    "return_std": ("sc:Float", "standard deviation of the episode returns"),
    "digest": ("sc:Text", "SHA-256 over the digests of all shard files"),
}
"""Fields of the table of subsets: name -> (type, meaning)."""


@dataclass(frozen=True)
class Publication:
    """Place and date of a release's publication.

    Attributes:
      url: its page; the benchmark's if it is not known.
      date: e.g. "2026-11-22".
    """

    url: str
    date: str


def page_of(url: str) -> str:
    """The web page of a URL: on the Hub the page of the data set, else the URL itself."""
    if on_the_hub(url):
        repository, folder, _ = parse_hub_url(url)
        page = f"https://huggingface.co/datasets/{repository}"
        return f"{page}/tree/main/{folder.rstrip('/')}" if folder else page
    return public(url)


def croissant(
    release: Release,
    facts: dict[str, Any],
    summary: str,
    citation: str,
    limits: Sequence[str],
    table: Path,
    published: Publication,
) -> str:
    """The JSON-LD document, from the template data/croissant.json.jinja.

    Args:
      facts: result of `describe_release`.
      summary: the description.
      citation: BibTeX.
      limits: known limits, a sentence each.
      table: file of the table of episodes, see `release.episode_table`.
      published: place and date of publication.
    """
    manifest = release.manifest
    text = fill(
        "croissant.json.jinja",
        manifest=manifest,
        summary=summary,
        citation=citation,
        limits=limits,
        published=published,
        tasks=", ".join(dict.fromkeys(record.task for record in manifest.subsets)),
        inputs=_inputs(manifest),
        files=list(_files(release, table)),
        folders=[f"{subset_path(name)}/**" for name in release.subsets],
        fields=FIELDS,
        rows=_rows(release, facts),
        columns={name: (TYPES.get(str(kind), "sc:Integer"), text) for name, (kind, text) in COLUMNS.items()},
        table=TABLE,
    )
    return json.dumps(json.loads(text), indent=1) + "\n"


def _inputs(manifest: Manifest) -> list[str]:
    """What the data were made from: recipe, policies, videos."""
    policies = {f"policy {policy.name} {policy.digest[:12]}" for r in manifest.subsets for policy in r.policies}
    videos = {f"videos {r.backgrounds['digest'][:12]}" for r in manifest.subsets if r.backgrounds}
    return ["the recipe in manifest.json", *sorted(policies), *sorted(videos)]


def _files(release: Release, table: Path) -> Iterator[dict[str, Any]]:
    """Manifest, Zarr groups and the table of episodes."""
    root = release.path
    yield _file(root / MANIFEST, MANIFEST, "application/json", "Recipe, versions, policies, digests of the release.")
    for name in release.subsets:
        path = f"{subset_path(name)}/zarr.json"
        yield _file(root / path, path, "application/json", f"Zarr group of {name}: arrays, dimensions, state fields.")
    yield _file(table, TABLE, "application/x-parquet", "A row an episode, with its first frame.")


def _file(file: Path, path: str, kind: str, text: str) -> dict[str, Any]:
    return dict(path=path, kind=kind, text=text, bytes=file.stat().st_size, sha256=sha256_file(file))


def _rows(release: Release, facts: dict[str, Any]) -> list[dict[str, Any]]:
    """The table of subsets."""
    rows = []
    for subset in facts["subsets"]:
        record = release[subset["name"]].record
        row = subset | {"task": record.task, "level": record.level, "setting": record.setting}
        row |= {f"return_{key}": subset["returns"][key] for key in ("mean", "std")}
        row["digest"] = subset["digest"] or ""
        rows.append({f"subsets/{key}": row[key] for key in FIELDS})
    return rows
