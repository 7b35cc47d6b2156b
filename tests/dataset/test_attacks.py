"""Hostile releases: each row is the smallest change that once was believed, ran code, filled memory or hung."""

from __future__ import annotations

import json
import os
import re
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from google_crc32c import value as crc32c
from numcodecs.zstd import Zstd

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import MAX_LIST_BYTES, MAX_SHARDS, Copy, canonical_json, list_bytes_limit
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.storage.store import open_store
from tests.dataset import made_up

NAME = "hop/random/dynamic"


def _rewrite_manifest(change: Callable[[dict], None]) -> Callable[[Path], None]:
    def attack(root: Path) -> None:
        manifest = json.loads((root / "manifest.json").read_bytes())
        change(manifest)
        (root / "manifest.json").write_bytes(canonical_json(manifest))

    return attack


def _chunk(root: Path, array: str = "pixels") -> Path:
    return next(path for path in sorted((root / "hop/random.zarr").rglob(f"{array}/c/**/*")) if path.is_file())


def _with_digests(root: Path, chunk: Path, data: bytes) -> None:
    """Put other bytes into a chunk and make list and manifest agree with them, as an author of a release can."""
    manifest = json.loads((root / "manifest.json").read_bytes())
    for layer in manifest["layers"]:
        listed = json.loads((root / f"layers/{layer['list']}.json").read_bytes())
        for shard in listed["shards"][:1]:
            for array, file in shard["files"].items():
                if chunk.is_relative_to(root / layer["group"] / array):
                    file |= {"bytes": len(data), "sha256": sha256_bytes(data)}
        text = canonical_json(listed)
        layer["list"] = sha256_bytes(text)
        (root / f"layers/{layer['list']}.json").write_bytes(text)
    (root / "manifest.json").write_bytes(canonical_json(manifest))
    chunk.write_bytes(data)


def _bomb(root: Path) -> None:
    """A chunk of a few bytes that decodes to 512 MB."""
    frame = Zstd(level=19).encode(np.zeros(2**29, np.uint8))
    checked = frame + crc32c(frame).to_bytes(4, "little")
    _with_digests(root, _chunk(root, "length"), checked)


def _replaced(make: Callable[[Path], None], find: Callable[[Path], Path]) -> Callable[[Path], None]:
    def attack(root: Path) -> None:
        path = find(root)
        path.unlink()
        make(path)

    return attack


def _manifest_file(root: Path) -> Path:
    return root / "manifest.json"


def _list_file(root: Path) -> Path:
    first = json.loads(_manifest_file(root).read_bytes())["layers"][0]  # which is read; a disk lists any one first
    return root / "layers" / f"{first['list']}.json"


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**36)


def _link_out(path: Path) -> None:
    (path.parent / "elsewhere").write_bytes(b"{}")
    path.symlink_to(path.parent / "elsewhere")


def _altered_list(root: Path) -> None:
    listed = json.loads(_list_file(root).read_bytes())
    next(iter(listed["shards"][0]["files"].values()))["sha256"] = "0" * 64
    _list_file(root).write_bytes(canonical_json(listed))


def _copy_without_end(root: Path) -> None:
    copy = canonical_json(Copy(manifest=sha256_bytes(_manifest_file(root).read_bytes())))
    (root / "copy.json").write_bytes(copy.replace(b"{}", b'{"hop/none": [[0, 1000000000000000]]}'))


FILE = {"bytes": 1, "sha256": "0" * 64}


def _with_list(change: Callable[[dict], None]) -> Callable[[Path], None]:
    """Change the first layer's list, and the manifest accordingly."""

    def attack(root: Path) -> None:
        listed = json.loads(_list_file(root).read_bytes())
        change(listed)
        text = canonical_json(listed)
        (root / f"layers/{sha256_bytes(text)}.json").write_bytes(text)
        _rewrite_manifest(lambda m: m["layers"][0].update(list=sha256_bytes(text)))(root)

    return attack


ATTACKS: dict[str, Callable[[Path], None]] = {
    "an older format": _rewrite_manifest(lambda m: m.update(schema_version=2)),
    "an unknown codec": _rewrite_manifest(lambda m: m["layers"][0]["arrays"][0].update(codec="pickle")),
    "an unknown dtype": _rewrite_manifest(lambda m: m["layers"][0]["arrays"][0].update(dtype="object")),
    "a group outside": _rewrite_manifest(lambda m: m["layers"][0].update(group="../../home")),
    "a chunk of terabytes": _rewrite_manifest(lambda m: m["layers"][0]["arrays"][0].update(shape=[10**7, 10**7])),
    "more episodes than shards": _rewrite_manifest(lambda m: [s.update(episodes=10**6) for s in m["subsets"]]),
    "a subset twice": _rewrite_manifest(lambda m: m["subsets"].append(m["subsets"][0])),
    "names that differ in case alone": _rewrite_manifest(
        lambda m: m["subsets"].append(m["subsets"][0] | {"name": m["subsets"][0]["name"].upper()})
    ),
    "a name that clears the screen": _rewrite_manifest(lambda m: m.update(license="\x1b[2J")),
    "videos outside": _rewrite_manifest(
        lambda m: m["subsets"][0].update(backgrounds={"source": "../home", "split": "train", "digest": "0" * 64})
    ),
    "a layer that is not described": _rewrite_manifest(lambda m: m["subsets"][0]["layers"].append("hop/none")),
    "another list": _rewrite_manifest(lambda m: m["layers"][0].update(list="0" * 64)),
    "a copy of another release": lambda root: (root / "copy.json").write_bytes(canonical_json(Copy(manifest="0" * 64))),
    "a copy of shards without end": _copy_without_end,
    "deep JSON": lambda root: _manifest_file(root).write_bytes(b"[" * 10**6),
    "a manifest of 64 GB": _replaced(_sparse, _manifest_file),
    "a manifest that is a pipe": _replaced(os.mkfifo, _manifest_file),
    "a manifest that is a link": _replaced(_link_out, _manifest_file),
    "a list of 64 GB": _replaced(_sparse, _list_file),
    "a list that was altered": _altered_list,
    "a list that is short": _with_list(lambda listed: listed["shards"].pop()),
    "an array of no layer": _with_list(
        lambda listed: listed["shards"][0]["files"].update(x={"bytes": 1, "sha256": "0" * 64})
    ),
    "a chunk that is missing": lambda root: _chunk(root).unlink(),
    "a chunk that is cut": lambda root: _chunk(root).write_bytes(_chunk(root).read_bytes()[:-9]),
    "a chunk that is a pipe": _replaced(os.mkfifo, _chunk),
    "a chunk that is a device": _replaced(lambda path: path.symlink_to("/dev/zero"), _chunk),
    "a chunk that is a link": _replaced(_link_out, _chunk),
    "a chunk that decodes to 512 MB": _bomb,
}
SAID = {
    "an unknown codec": r"layers\.0\.arrays\.0\.codec",
    "an unknown dtype": r"layers\.0\.arrays\.0\.dtype",
    "a chunk of terabytes": "larger shards than any release has",
    "a copy of another release": "is a copy of release 0000",
    "a copy of shards without end": "not runs of numbers|more shards than",
    "a list that was altered": "was altered",
    "a list that is short": "lists 1 shards, and the manifest says 2",
    "an array of no layer": "names array",
}
"""Words of the refusal, where another check would refuse the attack, too."""


def _many_episodes(manifest: dict) -> None:
    manifest["layers"] = [layer | {"shards": 10**5, "episodes_per_shard": 50} for layer in manifest["layers"]]
    manifest["subsets"] = [manifest["subsets"][0] | {"name": f"hop/{n}", "episodes": 4 * 10**6} for n in range(3)]


def _many_shards(manifest: dict) -> None:
    others = [manifest["layers"][0] | {"name": f"a{n}/t", "group": f"a{n}.zarr/t"} for n in range(11)]
    manifest["layers"] = [layer | {"shards": MAX_SHARDS} for layer in (*manifest["layers"], *others)]


def _copy_of_everything(root: Path) -> None:
    promised = {f"hop/{n}": ((0, MAX_SHARDS),) for n in range(11)}
    copy = {"format": "dmcvb-gen copy", "manifest": sha256_bytes(_manifest_file(root).read_bytes()), "source": ""}
    (root / "copy.json").write_bytes(canonical_json(copy | {"promised": promised}))


def _infinite(root: Path) -> None:
    text = _manifest_file(root).read_text()
    _manifest_file(root).write_text(re.sub(r'"seconds_per_step":[0-9.]+', '"seconds_per_step":1e999', text))


REFUSED = {
    "more episodes than the 10,000,000": _rewrite_manifest(_many_episodes),
    "more shards than the .* release may have": _rewrite_manifest(_many_shards),
    "not valid at the top: .*more shards than": _copy_of_everything,
    "is no policy and no video": _rewrite_manifest(lambda m: m["inputs"].append(FILE | {"path": "recipes/0.json"})),
    "holds no trajectories": _rewrite_manifest(lambda m: m["subsets"][0]["layers"].pop(0)),
    "has no labels, or no renderer": _rewrite_manifest(lambda m: m["subsets"][0].update(renderer={})),
    "was not written by dmcvb-gen, or changed": lambda root: _manifest_file(root).write_text(
        json.dumps(json.loads(_manifest_file(root).read_bytes()), indent=1)
    ),
    "appears twice": _rewrite_manifest(lambda m: m["layers"].append(m["layers"][0])),
    "seconds_per_step": _infinite,
    "renderer.samples": _rewrite_manifest(lambda m: m["subsets"][0].update(renderer={"samples": "\x1b]0;x\x07"})),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    root = tmp_path_factory.mktemp("sound") / "release"
    made_up.make(open_store(root), made_up.recipe(3))
    return root


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_is_one_line(sound, tmp_path, name):
    root = tmp_path / "release"
    shutil.copytree(sound, root)
    ATTACKS[name](root)
    tracemalloc.start()
    with pytest.raises(StoreError) as caught:
        subset = Release.open(root)[NAME]
        for array in subset.arrays:
            subset.read(array)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "\n" not in str(caught.value) and "\x1b" not in str(caught.value)
    assert re.search(SAID.get(name, ""), str(caught.value))
    assert peak < 2**28


@pytest.mark.parametrize("said", REFUSED)
def test_numbers_and_names_have_bounds(sound, tmp_path, said):
    shutil.copytree(sound, tmp_path / "release")
    REFUSED[said](tmp_path / "release")
    with pytest.raises(StoreError, match=said):
        Release.open(tmp_path / "release")


def test_the_bound_of_a_list_does_not_grow_with_its_layer(sound):
    layer = next(iter(Release.open(sound).layers.values()))
    many = layer.model_copy(update={"shards": MAX_SHARDS, "arrays": layer.arrays * 1000})
    assert list_bytes_limit(many) == MAX_LIST_BYTES
