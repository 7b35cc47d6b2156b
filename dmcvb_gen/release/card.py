"""Write and check a release's card: README.md, croissant.json, pictures and a table of episodes; attachments all.

Everything in a card comes from the manifest and the data. `check_card` writes another one and compares the files.
"""

import contextlib
import datetime
import json
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import CARD_FOLDER, MANIFEST, Manifest, Resolved
from dmcvb_gen.dataset.writer import read_provenance
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, StoreError
from dmcvb_gen.generate.info import STATISTICS, describe_release
from dmcvb_gen.generate.inputs import video_source
from dmcvb_gen.generate.preview import contact_sheet
from dmcvb_gen.loaders.painted import Painting, painted_release
from dmcvb_gen.options import Local, Location, checked
from dmcvb_gen.policies.header import OWN_CODE, origin_of
from dmcvb_gen.release.croissant import CITATION, HOME, croissant, derived_from, generator, groups, page_of
from dmcvb_gen.release.episode_table import CONFIG, TABLE, table_rows, write_table
from dmcvb_gen.release.templates import fill
from dmcvb_gen.spec import ALL_PARTS, CUE, DISTRACTOR_KINDS, DistractorSetting
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.storage.store import open_store
from dmcvb_gen.tasks import ACTION_REPEAT
from dmcvb_gen.text import pluralize

README, CROISSANT = "README.md", "croissant.json"
SHEET = f"{CARD_FOLDER}contact_sheet.png"
SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
"""Hugging Face's size categories, counted in steps."""


@checked
def write_card(release: Location, out: Local | None = None, url: str | None = None) -> list[Path]:
    """Write README.md, croissant.json, pictures and the table of episodes.

    Args:
      release (RELEASE): Folder of the release.
      out (FOLDER): Folder of the card. [default: the release]
      url: URL of the published release. [default: the card's]

    Raises:
      StoreError: there is no release, it has no episodes, or the folder cannot be written or has another README.md.
    """
    opened = _open(release)
    folder = local_path(out) if out else opened.path
    readme = folder / README
    if readme.is_file() and "dmcvb-gen" not in readme.read_text(errors="replace"):
        raise StoreError(f"{readme} is not a card, and it would be replaced; give another --out")
    store = open_store(folder)
    with tempfile.TemporaryDirectory() as scratch:  # so that a failure leaves no half of a card
        names = _write_files(opened, Path(scratch), folder, _published(folder, opened.manifest, url))
        for name in names:
            store.replace(name, (Path(scratch) / name).read_bytes())
    return [folder / name for name in names]


def _write_files(
    release: Release, made: Path, folder: Path, published: dict[str, str], keep_table: bool = False
) -> list[str]:
    """Write a card's files below `made`.

    Args:
      keep_table: take the table of `folder` if it has the same rows: other versions of pyarrow pack them differently.

    Returns:
      The files' names.
    """
    (made / CARD_FOLDER).mkdir()
    write_table(release, made / TABLE)
    if keep_table and table_rows(folder / TABLE) == table_rows(made / TABLE):
        shutil.copyfile(folder / TABLE, made / TABLE)
    facts = describe_release(release.path)
    limits = _limits(release, facts)
    summary = _summary(release, facts)
    texts = {
        README: card_text(release, facts, summary, limits),
        CROISSANT: croissant(release, facts, summary, limits, made / TABLE, published),
    }
    for name, text in texts.items():
        (made / name).write_text(text)
    Image.fromarray(_sheet(release)).save(made / SHEET, "PNG")
    return [*texts, SHEET, TABLE]


def _published(folder: Path, manifest: Manifest | Resolved, url: str | None = None) -> dict[str, str]:
    """The "url" and "date" of publication: the given one, else those of this version's existing card, else today."""
    known = None
    with contextlib.suppress(OSError, ValueError):
        known = json.loads((folder / CROISSANT).read_text())
    if not isinstance(known, dict) or known.get("version") != manifest.version:
        known = {}
    date = str(known.get("datePublished") or datetime.date.today().isoformat())
    return {"url": page_of(url) if url else str(known.get("url") or HOME), "date": date}


def check_card(root: str | Path) -> list[str]:
    """List the files of a release's card that are missing or do not match its data; empty if the card is right.

    The card of a copy describes the whole release, so only the rows of its local episodes are compared.

    Raises:
      StoreError: there is no release, or it has no episodes.
    """
    release = _open(root)
    folder = release.path
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch)
        names = _write_files(release, made, folder, _published(folder, release.manifest), keep_table=True)
        if release.copy:
            fits = table_rows(made / TABLE) <= table_rows(folder / TABLE)
            return [] if fits else [f"{TABLE} does not match the local episodes"]
        findings = [f"{name} is missing" for name in names if not (folder / name).is_file()]
        # Pictures need only exist: libraries draw differently.
        others = [name for name in names if not name.endswith(".png") and (folder / name).is_file()]
        differ = [name for name in others if (folder / name).read_bytes() != (made / name).read_bytes()]
        return findings + [f"{name} does not match the release" for name in differ]


def _open(root: Location) -> Release:
    """A finished release; of a part, its manifest names the subsets that have episodes here alone."""
    release = Release.open(root)
    if not release.subsets:
        raise StoreError(f"{root} has no episodes yet; run the rollout first")
    if release.in_the_making:
        raise StoreError(f"{root} is not complete; finish it with the same rollout, without --only")
    if release.manifest_path != MANIFEST:
        raise StoreError(f"{root} has grown since, and a card is of the whole of it; leave the digest out")
    here = tuple(record for record in release.manifest.subsets if record.name in release.subsets)
    manifest = release.manifest.model_copy(update={"subsets": here})
    return Release(release.store, manifest, release.digest, release.compared, release.copy)


def _sheet(release: Release) -> np.ndarray:
    """A strip of the first episode of each subset, rendered if it has no stored pictures."""
    chosen = painted_release(release, Painting(cache_bytes=0), missing=True)
    return contact_sheet([s for s in chosen.subsets.values() if s.pixel_arrays], episodes=1, scale=1)


# -- text -----------------------------------------------------------------------------------------


def _summary(release: Release, facts: dict[str, Any]) -> str:
    manifest = release.manifest
    tasks = ", ".join(dict.fromkeys(record.task for record in manifest.subsets))
    held = "pixels and states"
    if not release.manifest.imported:
        held = "pixels, states, full physics states and the labels of every visual distractor"
    if not any(subset["images"] for subset in facts["subsets"]):
        held = "states, full physics states and the labels of every visual distractor, from which `dmcvb-gen paint` "
        held += "makes the pictures"
    text = (
        f"{manifest.description} Offline-RL episodes of {tasks} with {held}: "
        f"{pluralize(len(facts['subsets']), 'subsets')}, "
        f"{pluralize(sum(subset['episodes'] for subset in facts['subsets']), 'episodes')}, {facts['steps']:,} steps."
    )
    if facts["part"]:
        planned = [*facts["missing"].values(), *(subset["episodes_planned"] for subset in facts["subsets"])]
        whole = f"{pluralize(len(planned), 'subsets')} and {pluralize(sum(planned), 'episodes')}"
        text += f" This is a part of {manifest.name} {manifest.version}, which has {whole}."
    return text.strip()


def header(manifest: Manifest | Resolved, steps: int, digest: str | None) -> str:
    """The YAML header that the Hugging Face Hub reads.

    `datasets` knows a local folder's table by its name and this header alone, so the header names the data.
    """
    category = next((name for limit, name in SIZES if steps < limit), "n>10M")
    facts = {
        "pretty_name": f"{manifest.name} {manifest.version}",
        "license": manifest.license.lower(),
        "task_categories": ["reinforcement-learning", "robotics"],
        "tags": ["offline-rl", "visual-distractors", "mujoco", "dm-control", "zarr", "croissant", "synthetic"],
        "size_categories": [category],
        "configs": [CONFIG | {"description": f"{steps} steps of {str(digest)[:16]}"}],
    }
    return f"---\n{yaml.safe_dump(facts, sort_keys=False, allow_unicode=True)}---"


def card_text(release: Release, facts: dict[str, Any], summary: str, limits: Sequence[str]) -> str:
    """The text of README.md, from the template data/card.md.jinja."""
    manifest = release.manifest
    text = fill(
        "card.md.jinja",
        manifest=manifest,
        digest=release.digest,
        facts=facts,
        summary=summary,
        limits=limits,
        header=header(manifest, facts["steps"], release.digest),
        step=_held(manifest),
        arrays=_arrays(release),
        statistics=STATISTICS,
        successes={s.name: float(s.read("terminated").mean()) for s in release.subsets.values() if s.record.goal_mode},
        distractors={r.setting: _varied(r.setting) for r in manifest.subsets if r.goal_mode is None},
        making=_making(release),
        policies=_policies(manifest),
        group=groups(release)[0],
        sheet=SHEET,
        table=TABLE,
        citation=CITATION,
    )
    return re.sub(r"\n{3,}", "\n\n", text)


HELD = {1: "one control step", 2: "two control steps", 4: "four control steps"}


def _held(manifest: Manifest | Resolved) -> str:
    """The control steps for which an action is held, in words."""
    return " or ".join(HELD[repeat] for repeat in sorted({record.action_repeat for record in manifest.subsets}))


def _arrays(release: Release) -> dict[tuple, list[str]]:
    """Rows (name, type, dimensions, sizes) of the table of arrays -> the subsets that have these arrays."""
    kinds: dict[tuple, list[str]] = {}
    for name, subset in release.subsets.items():
        arrays = [(array, subset.array(array)) for array in subset.arrays]
        rows = tuple(
            (subset.spec(n).stored_name, str(a.dtype), " x ".join(a.dimensions), " x ".join(map(str, a.shape[1:])))
            for n, a in arrays
        )
        kinds.setdefault(rows, []).append(name)
    return kinds


def _varied(name: str) -> str:
    """The parts of a distractor that vary, with their scales, in words."""
    if name == "none":
        return "the model's own camera, colors and sky"
    if name.partition("_")[0] not in DISTRACTOR_KINDS:
        return "a distractor of its author's own"
    setting = DistractorSetting.parse(name)
    videos = "all videos" if setting.videos is None else f"up to {setting.videos} videos"
    words = {"background": videos, CUE: f"correlation {setting.scale_of(CUE):g}"}
    varied = [part for part in ALL_PARTS if setting.varies(part)]
    return ", ".join(f"{part}: {words.get(part, f's = {setting.scale_of(part):g}')}" for part in varied)


def _making(release: Release) -> list[str]:
    records, made_by = release.manifest.subsets, generator(release)
    if release.manifest.imported:
        lines = [f"Imported by {made_by}; nothing was simulated or rendered."]
    else:
        seeds = sorted({str(layer.makes["seed"]) for layer in release.layers.values() if "seed" in layer.makes})
        lines = [f"Made by {made_by} from the recipe in `recipes/` (seed {', '.join(seeds)})."]
        used = sorted({f"{r.renderer.get('name')} ({r.renderer.get('samples')} samples a pixel)" for r in records})
        lines.append(f"Renderer: {', '.join(used)}.")
    videos = sorted({f"`{r.backgrounds['digest'][:12]}` ({r.backgrounds['split']})" for r in records if r.backgrounds})
    if videos:
        lines.append(f"Background videos: digest {', '.join(videos)}.")
    names = ("system", "cpu", "python", "mujoco", "torch", "zarr")
    environments = [note["environment"] for note in read_provenance(release.store)]
    said = [", ".join(f"{name} {made[name]}" for name in names if name in made) for made in environments]
    lines += [f"Environment {number}: {where}." for number, where in enumerate(dict.fromkeys(said), 1)]
    return [*lines, *(f"Derived: {source}." for source in derived_from(release))]


def _policies(manifest: Manifest | Resolved) -> list[tuple[str, str, str]]:
    """Rows (task, level, policies) of the table of behaviour policies."""
    rows = []
    for record in {(r.task, r.level): r for r in manifest.subsets}.values():
        policies = ", ".join(f"{policy.name} `{policy.digest[:12]}`" for policy in record.policies)
        unnamed = "those of the imported data" if record.imported else "uniform random actions"
        rows.append((record.task, record.level, policies or unnamed))
    return rows


def _limits(release: Release, facts: dict[str, Any]) -> list[str]:
    manifest, limits = release.manifest, []
    if not (facts["complete"] or facts["part"]):
        limits.append("Not complete: only a part of the recipe's shards exists.")
    if any((record.backgrounds or {}).get("source") == "builtin" for record in manifest.subsets):
        limits.append("Backgrounds are the generator's own clips of falling objects, not DMC-VB's Kubric videos.")
    limits += _lacking_videos(release)
    policies = {policy.digest: policy for record in manifest.subsets for policy in record.policies}.values()
    coded = [policy for policy in policies if policy.header.get("algorithm") == OWN_CODE]
    own = {f"Behaviour `{policy.name}`": policy.header["training"]["source_sha256"] for policy in coded}
    for layer in release.layers.values():
        if code := layer.makes.get("code"):
            what = "task" if layer.kind == "trajectories" else "distractor"
            own[f"{what.capitalize()} `{layer.makes[what]}`"] = code if what == "task" else ", ".join(code)
    limits += [
        f"{name} is code (SHA-256 of its source file: `{digest}`): its data are not regenerable without that code."
        for name, digest in own.items()
    ]
    if algorithms := {str(policy.header.get("algorithm", "unknown means")) for policy in policies} - {OWN_CODE}:
        how = " and ".join(origin_of(name) for name in sorted(algorithms))
        limits.append(f"Behaviour policies were trained {how}; the paper's by MPO.")
    if (held := _held(manifest)) != HELD[ACTION_REPEAT]:
        limits.append(f"An action is held for {held}, in DMC-VB for {HELD[ACTION_REPEAT]}.")
    if release.manifest.imported:
        limits.append("Imported data have no physics states and no labels, so nothing can be rendered from them.")
    else:
        limits.append("Another processor or library version may change bits; `regenerate --check` says how far.")
    return limits


def _lacking_videos(release: Release) -> list[str]:
    """A sentence for each number of background videos that a setting names and that is more than there are."""
    found: dict[str, None] = {}
    for record in release.manifest.subsets:
        own = record.setting.partition("_")[0] not in DISTRACTOR_KINDS  # whose code may not be here
        if not record.backgrounds or own or not record.distractor.videos:
            continue
        with contextlib.suppress(BackgroundError):  # a folder of videos that is elsewhere now
            there = len(load_backgrounds(video_source(release.place, record), record.split))
            if there < record.distractor.videos:
                found[f"{record.distractor.videos} background videos are asked for, and {there} are there."] = None
    return list(found)
