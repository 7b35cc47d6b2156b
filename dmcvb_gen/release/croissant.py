"""A release in, its Croissant metadata out (mlcommons.org/croissant, version 1.1, with its RAI terms)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import MANIFEST, MANIFEST_BYTES, ZARR_JSON
from dmcvb_gen.dataset.writer import read_provenance
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.release.episode_table import COLUMNS, TABLE
from dmcvb_gen.release.templates import fill
from dmcvb_gen.storage.hugging_face import HubStore
from dmcvb_gen.storage.places import shown
from dmcvb_gen.storage.store import open_store

HOME = "https://arxiv.org/abs/2409.18330"
"""The page of the benchmark that releases follow."""
CITATION = """@inproceedings{ortiz2024dmcvb,
  title     = {{DMC-VB}: A Benchmark for Representation Learning for Control with Visual Distractors},
  author    = {Ortiz, Joseph and Dedieu, Antoine and Lehrach, Wolfgang and Guntupalli, J. Swaroop and
               Wendelken, Carter and Humayun, Ahmad and Zhou, Guangyao and Swaminathan, Sivaramakrishnan and
               L{\\'a}zaro-Gredilla, Miguel and Murphy, Kevin},
  booktitle = {Advances in Neural Information Processing Systems, Datasets and Benchmarks Track},
  year      = {2024}
}"""
TYPES = {"string": "sc:Text", "bool": "sc:Boolean", "float64": "sc:Float", "image": "sc:ImageObject"}
"""Types of the table of episodes that are no integers."""
FIELDS = {
    "name": ("sc:Text", "task/level/distractor"),
    "task": ("sc:Text", "what is done"),
    "level": ("sc:Text", "skill of the behaviour policies"),
    "setting": ("sc:Text", "distractors or goals"),
    "episodes": ("sc:Integer", "episodes here"),
    "steps": ("sc:Integer", "transitions here"),
    "bytes": ("sc:Integer", "bytes of all shards"),
    "return_mean": ("sc:Float", "mean episode return"),
    "return_std": ("sc:Float", "standard deviation of the episode returns"),
}
"""Fields of the table of subsets: name -> (type, meaning)."""


def page_of(url: str) -> str:
    """The web page of a URL: on the Hub the page of the data set, else the URL itself."""
    if url.startswith("hf:") and isinstance(store := open_store(url), HubStore):
        page = f"https://huggingface.co/datasets/{store.repository}"
        return f"{page}/tree/main/{store.folder_there.rstrip('/')}" if store.folder_there else page
    return shown(url)


def groups(release: Release) -> list[str]:
    """Folders of the Zarr groups that are here, one a set of trajectories."""
    used = [layer.group.partition(".zarr/")[0] for layer in release.layers.values() if release.here(layer.name)]
    return [f"{name}.zarr" for name in dict.fromkeys(used)]


def generator(release: Release) -> str:
    """The program that made a release, with its versions."""
    made = (f"dmcvb-gen {note['environment'].get('dmcvb-gen', '?')}" for note in read_provenance(release.store))
    return " and ".join(dict.fromkeys(made)) or "dmcvb-gen"


def derived_from(release: Release) -> list[str]:
    """What a release was made from, in words."""
    found = [recipe.derived for recipe in release.recipes if recipe.derived]
    return [f"{facts.get('kind')} of {facts.get('name')} {facts.get('version', '')}".strip() for facts in found]


def croissant(
    release: Release, facts: dict[str, Any], summary: str, limits: Sequence[str], table: Path, published: dict[str, str]
) -> str:
    """The JSON-LD document, from the template data/croissant.json.jinja.

    Args:
      facts: result of `describe_release`.
      summary: the description.
      limits: known limits, a sentence each.
      table: file of the table of episodes, see `release.episode_table`.
      published: "url" and "date" of publication; the benchmark's page if its own is not known.
    """
    manifest = release.manifest
    text = fill(
        "croissant.json.jinja",
        manifest=manifest,
        generator=generator(release),
        derived=derived_from(release),
        summary=summary,
        citation=CITATION,
        limits=limits,
        published=published,
        tasks=", ".join(dict.fromkeys(record.task for record in manifest.subsets)),
        inputs=_inputs(release),
        files=list(_files(release, table)),
        folders=[f"{group}/**" for group in groups(release)],
        fields=FIELDS,
        rows=list(_rows(release, facts)),
        columns={name: (TYPES.get(kind, "sc:Integer"), text) for name, (kind, text) in COLUMNS.items()},
        table=TABLE,
    )
    return json.dumps(json.loads(text), indent=1) + "\n"


def _inputs(release: Release) -> list[str]:
    """What the data were made from: recipe, policies, videos."""
    manifest = release.manifest
    policies = {f"policy {policy.name} {policy.digest[:12]}" for r in manifest.subsets for policy in r.policies}
    videos = {f"videos {r.backgrounds['digest'][:12]}" for r in manifest.subsets if r.backgrounds}
    return ["the recipe in recipes/", *sorted(policies), *sorted(videos)]


def _files(release: Release, table: Path) -> Iterator[dict[str, Any]]:
    """Manifest, Zarr groups and the table of episodes."""
    texts = {MANIFEST: "Subsets and layers, with the SHA-256 of each layer's list."}
    texts |= {
        f"{group}/{ZARR_JSON}": f"Zarr group {group}: arrays, dimensions, state fields." for group in groups(release)
    }
    texts |= {TABLE: "A row an episode, with its first frame."}
    for path, text in texts.items():
        data = table.read_bytes() if path == TABLE else release.store.read(path, MANIFEST_BYTES)
        kind = "application/x-parquet" if path == TABLE else "application/json"
        yield dict(path=path, kind=kind, text=text, bytes=len(data), sha256=sha256_bytes(data))


def _rows(release: Release, facts: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The table of subsets."""
    for subset in facts["subsets"]:
        record = release[subset["name"]].record
        row = subset | {"task": record.task, "level": record.level, "setting": record.setting}
        row |= {f"return_{key}": subset["returns"][key] for key in ("mean", "std")}
        yield {f"subsets/{key}": row[key] for key in FIELDS}
