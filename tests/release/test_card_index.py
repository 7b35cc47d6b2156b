"""The index of data set cards says what the cards' manifests say."""

from __future__ import annotations

import hashlib
import runpy
from pathlib import Path

from dmcvb_gen.dataset.manifest import MANIFEST
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
