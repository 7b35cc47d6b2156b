"""Croissant metadata (mlcommons.org/croissant, version 1.0) of a release, for search engines and loaders."""

from __future__ import annotations

from typing import Any

from dmcvb_gen.store import Release
from dmcvb_gen.store.manifest import MANIFEST
from dmcvb_gen.store.writer import sha256_file, subset_path

LICENSES = {
    "CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/",
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
}
HOME = "https://arxiv.org/abs/2409.18330"
"""The page of the benchmark that releases follow."""
_TERMS = (
    "citeAs column conformsTo equivalentProperty extract field fileProperty fileObject fileSet format includes "
    "isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace samplingRate "
    "separator source subField transform"
)
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{term: f"cr:{term}" for term in _TERMS.split()},
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "sc": "https://schema.org/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
}
"""The vocabulary's JSON-LD context."""
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


def croissant(release: Release, facts: dict[str, Any], summary: str, citation: str) -> dict[str, Any]:
    """The JSON-LD document.

    Args:
      facts: of `describe_release`.
      summary: the description.
      citation: BibTeX.
    """
    manifest, root = release.manifest, release.path
    files = [_file(root, MANIFEST, "application/json", "Recipe, versions, policies and digests of the release.")]
    for name in release.subsets:
        path = f"{subset_path(name)}/zarr.json"
        files.append(_file(root, path, "application/json", f"Zarr group of {name}: arrays, dimensions, state fields."))
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
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": manifest.name,
        "description": summary,
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "license": LICENSES.get(manifest.license, f"https://spdx.org/licenses/{manifest.license}.html"),
        "url": HOME,
        "version": manifest.version,
        "citeAs": citation,
        "keywords": ["offline reinforcement learning", "visual distractors", "MuJoCo", "Zarr"],
        "creator": [{"@type": "sc:Person", "name": author} for author in manifest.authors]
        or [{"@type": "sc:Organization", "name": manifest.generator}],
        "distribution": files,
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "subsets",
                "name": "subsets",
                "description": "What the release is composed of, a row a subset.",
                "field": [
                    {
                        "@type": "cr:Field",
                        "@id": f"subsets/{name}",
                        "name": name,
                        "description": text,
                        "dataType": kind,
                    }
                    for name, (kind, text) in FIELDS.items()
                ],
                "data": rows,
            }
        ],
    }


def _file(root, path: str, kind: str, text: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": path,
        "name": path.replace("/", "_"),
        "description": text,
        "contentUrl": path,
        "encodingFormat": kind,
        "contentSize": f"{(root / path).stat().st_size} B",
        "sha256": sha256_file(root / path),
    }
