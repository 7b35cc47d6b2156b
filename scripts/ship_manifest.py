"""Put manifests and indexes of releases into the package, so that `regenerate --manifest NAME` finds them.

python scripts/ship_manifest.py releases/quickstart
python scripts/ship_manifest.py --join dmcvb-v1 dmcvb-v1-locomotion dmcvb-v1-empty7x7 releases/dmcvb-v1-easy7x7a
"""

import argparse
from pathlib import Path

from dmcvb_gen.dataset.index import INDEX
from dmcvb_gen.dataset.manifest import MANIFEST
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.files import json_bytes
from dmcvb_gen.generate.join import join
from dmcvb_gen.generate.recipe import load_recipe
from dmcvb_gen.generate.shipped import ENDING, pack, write_archive

FOLDER = Path(__file__).parents[1] / "dmcvb_gen/generate/data/manifests"

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("releases", nargs="+", help="folders of finished releases; with --join also shipped names")
parser.add_argument("--join", metavar="RECIPE", help="make one manifest, of the release that this recipe gives")
arguments = parser.parse_args()
if arguments.join:
    manifest, index = join(load_recipe(arguments.join), arguments.releases)
    out = FOLDER / f"{manifest.name}{ENDING}"
    size = pack({MANIFEST: json_bytes(manifest), INDEX: json_bytes(index)}, out)
    print(f"{out}: {size:,} bytes; root digest {manifest.digest}")
else:
    for release in arguments.releases:
        out = FOLDER / f"{load_manifest(release)[1].name}{ENDING}"
        print(f"{out}: {write_archive(release, out):,} bytes")
