"""Put manifests of releases into the package, so that `regenerate --manifest NAME` finds them.

Their digests of files go into dataset_cards/NAME/files.tar.xz; the package has one of each shard.

python scripts/ship_manifest.py releases/quickstart
python scripts/ship_manifest.py --join dmcvb-v1 dataset_cards/dmcvb-v1-*/files.tar.xz
python scripts/ship_manifest.py --join dmcvb-v1 --folder releases/dmcvb-v1 releases/dmcvb-v1-*
"""

import argparse
from pathlib import Path

from dmcvb_gen.dataset.index import INDEX, Index
from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.files import json_bytes
from dmcvb_gen.generate.join import join, join_folders
from dmcvb_gen.generate.recipe import load_recipe
from dmcvb_gen.generate.shipped import ENDING, manifest_source, pack, read_complete, with_shard_digests

ROOT = Path(__file__).parents[1]


def ship(manifest: Manifest, index: Index) -> None:
    """Write both archives of a release."""
    card, package = ROOT / "dataset_cards" / manifest.name, ROOT / "dmcvb_gen/generate/data/manifests"
    card.mkdir(exist_ok=True)
    members = {MANIFEST: json_bytes(manifest), INDEX: json_bytes(index)}
    sizes = (
        pack(members, card / f"files{ENDING}"),
        pack(with_shard_digests(manifest, index), package / f"{manifest.name}{ENDING}"),
    )
    print(f"{manifest.name}: {sizes[0]:,} bytes beside its card, {sizes[1]:,} in the package; {manifest.digest}")


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("releases", nargs="+", help="folders of finished releases, or archives of manifests and indexes")
parser.add_argument("--join", metavar="RECIPE", help="make one manifest, of the release that this recipe gives")
parser.add_argument("--folder", help="with --join: write the joined release there, of links to the files of its parts")
arguments = parser.parse_args()
if arguments.folder and not arguments.join:
    parser.error("--folder needs --join RECIPE")
if arguments.folder:
    join_folders(load_recipe(arguments.join), arguments.releases, arguments.folder)
    ship(*read_complete(arguments.folder))
elif arguments.join:
    ship(*join(load_recipe(arguments.join), arguments.releases))
else:
    for release in arguments.releases:
        if Path(release).is_dir():
            ship(*read_complete(release))
        else:
            with manifest_source(release) as folder:
                ship(*read_complete(folder))
