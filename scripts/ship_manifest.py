"""Put the manifests of releases into the package, so that `regenerate --manifest NAME` finds them.

The package has the digest of each record. Manifest, recipes and lists, with the digest of each file, go into
dataset_cards/NAME/files.tar.xz; unpacked, they are a release without data.

python scripts/ship_manifest.py releases/quickstart
"""

import argparse
import tarfile
from pathlib import Path

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import MANIFEST, RECIPES
from dmcvb_gen.generate.shipped import ENDING, pack
from dmcvb_gen.release.tree import list_files

ROOT = Path(__file__).parents[1]


def bare(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    """An entry without owner and time, so that equal releases give equal archives."""
    entry.uid = entry.gid = entry.mtime = 0
    entry.uname = entry.gname = ""
    return entry


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("releases", nargs="+", type=Path, help="folders of finished releases")
for folder in parser.parse_args().releases:
    release = Release.open(folder)
    name = release.manifest.name
    card = ROOT / "dataset_cards" / name
    card.mkdir(exist_ok=True)
    with tarfile.open(card / "files.tar.xz", "w:xz", preset=9) as archive:
        recipes = (f"{RECIPES}{recipe.sha256}.json" for recipe in release.recipes)
        for path in (MANIFEST, *recipes, *(file.path for file in list_files(release, release.layers))):
            archive.add(folder / path, path, filter=bare)
    size = pack(release, ROOT / f"dmcvb_gen/generate/data/manifests/{name}{ENDING}")
    beside = (card / "files.tar.xz").stat().st_size
    print(f"{name}: {beside:,} bytes beside its card, {size:,} in the package; {release.digest}")
