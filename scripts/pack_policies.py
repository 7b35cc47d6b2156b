"""Pack the policy files FOLDER/<task>/<level>.safetensors into the archives that the package brings.

python scripts/pack_policies.py --unpack /tmp/policies     # today's files, to change or add some
python scripts/pack_policies.py /tmp/policies
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from dmcvb_gen.policies.archives import bundled_digests, bundled_file, pack

DATA = Path(__file__).parent.parent / "dmcvb_gen" / "policies" / "data"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--unpack", action="store_true", help="write the bundled files into FOLDER instead")
    given = parser.parse_args()
    if given.unpack:
        for name in bundled_digests():
            (given.folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(bundled_file(name), given.folder / name)
        print(f"{given.folder}: {len(bundled_digests())} policies")
        return
    pack(given.folder, DATA)
    sizes = {path.name: path.stat().st_size for path in DATA.glob("*.xz")}
    print(f"{sum(sizes.values()) / 1e6:.1f} MB: " + ", ".join(f"{name} {size:,}" for name, size in sizes.items()))


if __name__ == "__main__":
    main()
