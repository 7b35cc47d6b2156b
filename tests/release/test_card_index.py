"""The index of data set cards says what the cards' manifests say."""

from __future__ import annotations

import hashlib
import runpy
from pathlib import Path

from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.generate.shipped import load_shipped

TOP = Path(__file__).parents[2]


def test_the_index_is_that_of_the_cards():
    index = runpy.run_path(str(TOP / "docs/_scripts/card_index.py"))["index"]
    page = (TOP / "dataset_cards/README.md").read_text()
    assert page == index()
    for path in (TOP / "dataset_cards").glob(f"*/{MANIFEST}"):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert digest[:16] in page and f"({path.parent.name}/README.md)" in page
        assert load_shipped(path.parent.name).digest == digest
        assert (path.parent / "README.md").exists()


def test_the_report_beside_the_card_is_of_this_release():
    folder = TOP / "dataset_cards/dmcvb-mini"
    card = (folder / "README.md").read_text().replace("`", "").replace("DMC-VB paper", "the paper")
    lines = (folder / "report.md").read_text().splitlines()
    returns = [line for line in lines[lines.index("## Episode returns") : lines.index("## Scores")] if "/" in line]
    assert len(returns) == 71 and all(line in card for line in returns)
    manifest = Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    assert lines[0] == f"# Validation of {manifest.name} {manifest.version}"
    assert lines[2].startswith(
        f"Sound: {len(manifest.subsets)} subsets, {sum(s.episodes for s in manifest.subsets):,} "
    )
