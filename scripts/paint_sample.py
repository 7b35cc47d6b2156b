"""Paint a random share of a shipped release's shards twice, and compare the digests of all files.

    python scripts/paint_sample.py dmcvb-v1-locomotion --share 0.02
    python scripts/paint_sample.py dmcvb-v1-locomotion --share 0.0005 --seed 1    # one shard

Each shard is first made from the manifest without pictures, and its digests are compared with the manifest's. Then two
copies of it are painted. Printed are the frames a second of one core, and how long painting all of the release takes
at that pace. Exit code 1 if any digest differs.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import dmcvb_gen
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import FileRecord, Manifest, shard_episodes
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.dataset.shards import ShardKey, chosen_shards
from dmcvb_gen.generate.shipped import manifest_source


def sample(manifest: Manifest, share: float, seed: int) -> list[ShardKey]:
    """So large a share of the shards of a manifest, at least one, drawn without replacement."""
    shards = sorted(chosen_shards(manifest))
    count = max(1, round(share * len(shards)))
    drawn = np.random.default_rng(seed).choice(len(shards), count, replace=False)
    return [shards[index] for index in sorted(drawn)]


def painted(release: Path, key: ShardKey) -> tuple[tuple[FileRecord, ...], float]:
    """Paint the only shard of a release: its files, and the processor's seconds."""
    started = time.process_time()
    dmcvb_gen.paint(release, progress=False)
    seconds = time.process_time() - started
    return open_release(release)[key[0]].commits[key[1]].files, seconds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest", help="name of a shipped manifest without pictures")
    parser.add_argument("--share", type=float, default=0.02, help="share of the shards")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw")
    options = parser.parse_args()
    with manifest_source(options.manifest) as source:
        manifest = load_manifest(source)[1]
    total = sum(record.episodes for record in manifest.subsets)
    frames, episodes, seconds, wrong = 0, 0, 0.0, 0
    for key in sample(manifest, options.share, options.seed):
        subset, shard = key
        span = shard_episodes(next(record for record in manifest.subsets if record.name == subset), shard)
        with tempfile.TemporaryDirectory() as folder:
            first, second = Path(folder) / "first", Path(folder) / "second"
            made = dmcvb_gen.regenerate(
                manifest=options.manifest, only=subset, episodes=span, out=first, progress=False
            )
            if open_release(first)[subset].commits[shard].painted:
                sys.exit(f"{options.manifest} has pictures; compare them with dmcvb-gen regenerate --check")
            shutil.copytree(first, second, symlinks=True)
            (one, spent), (other, more) = painted(first, key), painted(second, key)
            steps = open_release(first)[subset].commits[shard].steps
        same = made.sound and one == other
        frames, seconds, wrong = frames + steps, seconds + spent + more, wrong + (not same)
        episodes += span[1] - span[0]
        pace = f"{2 * steps / (spent + more):,.0f} frames/s"
        print(f"{subset} shard {shard}: {steps:,} frames, {pace}, {'equal' if same else 'DIFFERENT'}", flush=True)
    pace = 2 * frames / seconds
    hours = frames / episodes * total / pace / 3600
    print(
        f"{frames:,} frames of {episodes:,} episodes painted twice, {wrong} shards differ; {pace:,.0f} frames/s of one "
        f"core, all {total:,} episodes: {hours:.1f} core-hours"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
