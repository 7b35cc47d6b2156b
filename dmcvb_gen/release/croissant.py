"""Write a release's Croissant metadata (mlcommons.org/croissant, version 1.1, with its RAI terms)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset import Release
from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.dataset.writer import sha256_file, subset_path
from dmcvb_gen.release.episode_table import COLUMNS, PICTURE, TABLE
from dmcvb_gen.storage.hub import on_the_hub, parse_hub_url
from dmcvb_gen.storage.remote import public

LICENSES = {
    "CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/",
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
}
HOME = "https://arxiv.org/abs/2409.18330"
"""The page of the benchmark that releases follow."""
CONFORMS_TO = ["http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0"]
_TERMS = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileProperty fileObject fileSet format "
    "includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace "
    "samplingRate separator source subField transform"
)
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{term: f"cr:{term}" for term in _TERMS.split()},
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "prov": "http://www.w3.org/ns/prov#",
    "dct": "http://purl.org/dc/terms/",
    "sc": "https://schema.org/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
}
"""The vocabulary's JSON-LD context."""
COLLECTED_BY = ["Synthetic", "Software Collection"]
"""Terms of Croissant's vocabulary for responsible AI."""
TYPES = {"string": "sc:Text", "bool": "sc:Boolean", "double": "sc:Float"}
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


@dataclass(frozen=True)
class Publication:
    """Place and date of a release's publication.

    Attributes:
      url: its page; None if it is not known.
      date: e.g. "2026-11-22".
    """

    url: str | None
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
) -> dict[str, Any]:
    """The JSON-LD document.

    Args:
      facts: result of `describe_release`.
      summary: the description.
      citation: BibTeX.
      limits: known limits, a sentence each.
      table: file of the table of episodes, see `release.episode_table`.
      published: place and date of publication.
    """
    manifest = release.manifest
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": manifest.name,
        "description": summary,
        "conformsTo": CONFORMS_TO,
        "license": LICENSES.get(manifest.license, f"https://spdx.org/licenses/{manifest.license}.html"),
        "url": published.url or HOME,
        "version": manifest.version,
        "datePublished": published.date,
        "citeAs": citation,
        "isLiveDataset": False,
        "keywords": ["offline reinforcement learning", "visual distractors", "MuJoCo", "Zarr", "synthetic data"],
        "creator": [{"@type": "sc:Person", "name": author} for author in manifest.authors]
        or [{"@type": "sc:Organization", "name": manifest.generator}],
        **_responsible(manifest, limits),
        **_provenance(manifest),
        "distribution": _files(release, table),
        "recordSet": [_subsets(release, facts), _episodes()],
    }


def _responsible(manifest: Manifest, limits: Sequence[str]) -> dict[str, Any]:
    """Answers to Croissant's vocabulary for responsible AI."""
    return {
        "rai:hasSyntheticData": True,
        **_collection(manifest),
        "rai:dataPreprocessingProtocol": "None after the simulation; pictures are compressed without loss.",
        "rai:dataAnnotationProtocol": "None by people: states, rewards and labels are the simulator's own.",
        "rai:dataLimitations": list(limits),
        "rai:dataBiases": [
            "States are visited as the behaviour policies visit them: expert data show few failures, random data few "
            "successes.",
            "Distractors are drawn from the ranges that the card names, and backgrounds from a small set of videos.",
        ],
        "rai:dataUseCases": [
            "Offline reinforcement learning, imitation and representation learning under visual distractors, and their "
            "evaluation. Not meant for judging systems that act in the real world.",
        ],
        "rai:dataSocialImpact": "Simulated bodies alone: no person is shown or described.",
        "rai:personalSensitiveInformation": "None.",
        "rai:dataReleaseMaintenancePlan": "A published version never changes; a changed byte is a new version, and "
        "CHANGELOG.md says what changed.",
    }


def _collection(manifest: Manifest) -> dict[str, Any]:
    """Describe how the data were collected, and which raw data are kept."""
    tasks = ", ".join(dict.fromkeys(record.task for record in manifest.subsets))
    if manifest.imported:
        return {
            "rai:dataCollection": f"Published episodes of {tasks}, simulated in MuJoCo, imported by "
            f"{manifest.generator}; pictures, states, actions and rewards are those published.",
            "rai:dataCollectionType": COLLECTED_BY,
            "rai:dataCollectionRawData": "Physics states and labels of distractors were not published.",
        }
    return {
        "rai:dataCollection": f"Simulated in MuJoCo by {manifest.generator}: behaviour policies act in {tasks}; every "
        "picture is painted from the simulated state and from distractors drawn from seeded streams.",
        "rai:dataCollectionType": COLLECTED_BY,
        "rai:dataCollectionRawData": "Physics states in full precision and the labels of all distractors are part of "
        "the data: every picture and reward can be made again from them.",
    }


def _provenance(manifest: Manifest) -> dict[str, Any]:
    """The program that made the data, and its inputs."""
    activity: dict[str, Any] = {
        "@type": "prov:Activity",
        "prov:label": "import published episodes"
        if manifest.imported
        else "roll out behaviour policies and paint what they did",
        "prov:wasAssociatedWith": {"@type": "prov:SoftwareAgent", "prov:label": manifest.generator},
        "prov:used": [{"@type": "prov:Entity", "prov:label": "the recipe in manifest.json"}],
    }
    names = sorted({f"policy {p.name} {p.digest[:12]}" for record in manifest.subsets for p in record.policies})
    names += sorted({f"videos {r.backgrounds['digest'][:12]}" for r in manifest.subsets if r.backgrounds})
    activity["prov:used"] += [{"@type": "prov:Entity", "prov:label": name} for name in names]
    sources = [
        {"@type": "prov:Entity", "prov:label": f"{entry.get('kind')} from {entry.get('from')}"}
        for entry in manifest.lineage
    ]
    return {"prov:wasGeneratedBy": activity} | ({"prov:wasDerivedFrom": sources} if sources else {})


def _files(release: Release, table: Path) -> list[dict[str, Any]]:
    """Files of the release: manifest, Zarr groups, the table of episodes, and all shards as one set."""
    root = release.path
    files = [
        _file(root / MANIFEST, MANIFEST, "application/json", "Recipe, versions, policies, digests of the release.")
    ]
    for name in release.subsets:
        path = f"{subset_path(name)}/zarr.json"
        text = f"Zarr group of {name}: arrays, dimensions, state fields."
        files.append(_file(root / path, path, "application/json", text))
    files.append(_file(table, TABLE, "application/x-parquet", "A row an episode, with its first frame."))
    shards = {
        "@type": "cr:FileSet",
        "@id": "shards",
        "name": "shards",
        "description": "Zarr format 3: a shard file an array and run of episodes; files.json has the digest of each.",
        "encodingFormat": "application/vnd.zarr; version=3",
        "includes": [f"{subset_path(name)}/**" for name in release.subsets],
    }
    return [*files, shards]


def _subsets(release: Release, facts: dict[str, Any]) -> dict[str, Any]:
    """The record set of subsets, with its rows."""
    rows = []
    for subset in facts["subsets"]:
        record = release[subset["name"]].record
        row = {
            "task": record.task,
            "level": record.level,
            "setting": record.setting,
            "return_mean": subset["returns"]["mean"],
            "return_std": subset["returns"]["std"],
            "digest": subset["digest"] or "",
        }
        row |= {key: subset[key] for key in ("name", "episodes", "steps", "bytes")}
        rows.append({f"subsets/{key}": row[key] for key in FIELDS})
    fields = [_field("subsets", name, text, kind) for name, (kind, text) in FIELDS.items()]
    text = "What the release is composed of, a row a subset."
    return {"@type": "cr:RecordSet", "@id": "subsets", "name": "subsets", "description": text, "field": fields} | {
        "data": rows
    }


def _episodes() -> dict[str, Any]:
    """The record set of the table of episodes."""
    fields = []
    for name, (kind, text) in COLUMNS.items():
        picture = kind == PICTURE
        field = _field("episodes", name, text, "sc:ImageObject" if picture else TYPES.get(str(kind), "sc:Integer"))
        field["source"] = {"fileObject": {"@id": TABLE}, "extract": {"column": name}}
        if picture:
            field["source"]["transform"] = {"jsonPath": "bytes"}
        fields.append(field)
    text = "Every episode, its first frame as a picture."
    return {"@type": "cr:RecordSet", "@id": "episodes", "name": "episodes", "description": text, "field": fields}


def _field(records: str, name: str, text: str, kind: str) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{records}/{name}",
        "name": name,
        "description": text,
        "dataType": kind,
    }


def _file(file: Path, path: str, kind: str, text: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": path,
        "name": path.replace("/", "_"),
        "description": text,
        "contentUrl": path,
        "encodingFormat": kind,
        "contentSize": f"{file.stat().st_size} B",
        "sha256": sha256_file(file),
    }
