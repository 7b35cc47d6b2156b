"""Writes dataset_cards/README.md, the index of all cards, from the manifests beside them.

python docs/_scripts/card_index.py
python docs/_scripts/card_index.py --check    # exit code 1 if the index differs from the cards
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.files import sha256_file

CARDS = Path(__file__).parents[2] / "dataset_cards"
HEAD = """# Data set cards

Releases that this repository describes but does not hold. Each folder has the release's card, a contact sheet and its
manifest. The digest of a release is the SHA-256 of its manifest. The package has the digests of every shard by the
release's name, so any part is made on your machine and compared:

```text
dmcvb-gen regenerate --manifest quickstart --only '*/*/dynamic' --range 0:3 --out data/part
```

| release | version | subsets | episodes | tasks | digest |
|---|---|---|---|---|---|
"""


def row(folder: Path) -> str:
    """A release's line of the table."""
    manifest = Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    episodes = sum(subset.episodes for subset in manifest.subsets)
    families = sorted({subset.family for subset in manifest.subsets})
    tasks = len({subset.task for subset in manifest.subsets})
    return (
        f"| [{manifest.name}]({folder.name}/README.md) | {manifest.version} | {len(manifest.subsets)} "
        f"| {episodes:,} | {tasks} ({', '.join(families)}) | `{sha256_file(folder / MANIFEST)[:16]}` |\n"
    )


def index(cards: Path = CARDS) -> str:
    """The page, from every folder that holds a manifest, in order of names."""
    return HEAD + "".join(row(path.parent) for path in sorted(cards.glob(f"*/{MANIFEST}")))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="only compare")
    page, text = CARDS / "README.md", index()
    if parser.parse_args().check:
        same = page.exists() and page.read_text() == text
        print(f"{page} {'is up to date' if same else 'is out of date: python docs/_scripts/card_index.py'}")
        return 0 if same else 1
    page.write_text(text)
    print(f"wrote {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
