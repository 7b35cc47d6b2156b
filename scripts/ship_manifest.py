"""Put the manifest and index of a release into the package, so that `regenerate --manifest NAME` finds them.

python scripts/ship_manifest.py releases/quickstart
"""

import argparse
from pathlib import Path

from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.generate.shipped import write_archive

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("releases", nargs="+", help="folders of finished releases")
for release in parser.parse_args().releases:
    name = load_manifest(release)[1].name
    out = Path(__file__).parents[1] / "dmcvb_gen/generate/data/manifests" / f"{name}.tar.xz"
    print(f"{out}: {write_archive(release, out):,} bytes")
