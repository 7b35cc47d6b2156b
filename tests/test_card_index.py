"""The index of data set cards says what the cards' manifests say."""

from __future__ import annotations

import runpy
from pathlib import Path

from dmcvb_gen.store.manifest import MANIFEST, Manifest

TOP = Path(__file__).parents[1]


def test_the_index_is_that_of_the_cards():
    index = runpy.run_path(str(TOP / "scripts/make_card_index.py"))["index"]
    page = (TOP / "dataset_cards/README.md").read_text()
    assert page == index()
    for path in (TOP / "dataset_cards").glob(f"*/{MANIFEST}"):
        manifest = Manifest.model_validate_json(path.read_bytes())
        assert manifest.complete and manifest.digest[:16] in page and f"({path.parent.name}/README.md)" in page
        assert (path.parent / "README.md").exists()
