"""Batches a second of the agents' loader, beside a per-sample __getitem__ loop and torch's own DataLoader.

python scripts/bench_loader.py releases/mini --subset walker-walk/expert/dynamic
"""

from __future__ import annotations

import argparse
import os
import time

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from dmcvb_gen.agents.data import PAD, Source, TrainingData, load_data
from dmcvb_gen.store import open_release


class OneByOne(Dataset):
    """A frame stack a call: pad, crop, scale; as a data set is usually written. Pictures come from memory too."""

    def __init__(self, data: TrainingData):
        self.data, self.pictures = data, data.frames.pictures.cpu().numpy()
        self.rows, self.start = data.train_rows.cpu().numpy(), data.start.cpu().numpy()
        self.generator = np.random.default_rng(0)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int):
        row = self.rows[index]
        stack = np.concatenate([self.pictures[max(row - back, self.start[row])] for back in (2, 1, 0)])
        down, right = self.generator.integers(2 * PAD + 1, size=2)
        size = stack.shape[-1]
        padded = np.pad(stack, ((0, 0), (PAD, PAD), (PAD, PAD)), mode="symmetric")
        cut = padded[:, down : down + size, right : right + size].astype(np.float32) / 255 - 0.5
        return torch.from_numpy(cut), self.data.action[row]


def measure(name: str, make, batches: int, batch_size: int) -> tuple[float, float]:
    """Seconds of the processor and of the clock a batch, printed."""
    make()
    clock, processor = time.perf_counter(), time.process_time()
    for _ in range(batches):
        make()
    clock, processor = (time.perf_counter() - clock) / batches, (time.process_time() - processor) / batches
    print(
        f"{name:34s} {1000 * processor:8.1f} ms CPU {1000 * clock:8.1f} ms a batch {batch_size / clock:10,.0f} stacks/s"
    )
    return processor, clock


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("release")
    parser.add_argument("--subset", help="Default: the first one.")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--batches", type=int, default=20)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    release = open_release(options.release)
    subset = release[options.subset] if options.subset else next(iter(release.subsets.values()))
    started = time.perf_counter()
    data = load_data([Source(subset)], device=options.device)
    seconds = time.perf_counter() - started
    print(f"{subset.name}: {data.frames.table.nbytes / 1e6:.0f} MB of pictures read in {seconds:.1f} s")
    size, generator = options.batch_size, np.random.default_rng(0)
    loop, items = OneByOne(data), iter(())  # its pictures are the same ones

    def one_by_one():
        samples = [loop[index] for index in generator.integers(len(loop), size=size)]
        return torch.utils.data.default_collate(samples)

    def loader():
        nonlocal items
        batch = next(items, None)
        if batch is None:
            items = iter(DataLoader(loop, batch_size=size, shuffle=True, drop_last=True))
            batch = next(items)
        return batch

    processor, clock = measure("per-sample __getitem__ loop", one_by_one, options.batches, size)
    measure("DataLoader over __getitem__", loader, options.batches, size)
    ours = measure("TrainingData.batch", lambda: data.batch(size, generator), options.batches, size)
    half = measure(
        "... in bfloat16, as pictures train",
        lambda: data.batch(size, generator, dtype=torch.bfloat16),
        options.batches,
        size,
    )
    measure("... with the next observation", lambda: data.batch(size, generator, next_observation=True), 10, size)
    stored = load_data([Source(subset, episodes=20)], memory=0)
    measure("read from the shards", lambda: stored.batch(size, generator), 3, size)
    for name, (cpu, wall) in {"float32": ours, "bfloat16": half}.items():
        print(f"{name}: {processor / cpu:.1f} times faster than the loop (CPU), {clock / wall:.1f} (clock)")


if __name__ == "__main__":
    main()
