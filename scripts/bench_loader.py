"""Time of a batch from the agents' loader, beside a per-sample __getitem__ loop that does the same work.

python scripts/bench_loader.py releases/mini --subset walker-walk/expert/dynamic --threads 1 2

Both sides give the same pictures (checked first): stacks of three frames out of memory, one random shift a stack,
floats of the same type. They take turns batch by batch, so that whatever else the machine does slows both.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, default_collate

from dmcvb_gen.agents.data import PAD, Source, TrainingData, load_data, normalize_pixels
from dmcvb_gen.dataset import open_release


class OneByOne(Dataset):
    """A frame stack a call: pad, crop, scale; as a data set is usually written. Pictures come from memory too."""

    def __init__(self, data: TrainingData, dtype: torch.dtype):
        self.data, self.dtype, self.pictures = data, dtype, data.frames.pictures.cpu().numpy()
        self.rows, self.start = data.train_rows.cpu().numpy(), data.start.cpu().numpy()
        self.generator = np.random.default_rng(0)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        row = self.rows[index]
        return self.observe(row, *self.generator.integers(2 * PAD + 1, size=2)), self.data.action[row]

    def observe(self, row: int, down: int, right: int) -> torch.Tensor:
        stack = np.concatenate([self.pictures[max(row - back, self.start[row])] for back in (2, 1, 0)])
        size = stack.shape[-1]
        padded = np.pad(stack, ((0, 0), (PAD, PAD), (PAD, PAD)), mode="symmetric")
        cut = padded[:, down : down + size, right : right + size]
        return normalize_pixels(torch.from_numpy(cut), self.dtype)


def check(data: TrainingData, dtype: torch.dtype, count: int = 64) -> None:
    """Stop unless loop and loader give the same pictures for the same rows and shifts."""
    generator, loop = np.random.default_rng(1), OneByOne(data, dtype)
    rows = data.train_rows[torch.from_numpy(generator.integers(len(data), size=count)).to(data.device)]
    down, right = generator.integers(2 * PAD + 1, size=(2, count))
    shifts = torch.from_numpy(down).to(data.device), torch.from_numpy(right).to(data.device)
    ours = data.observe(rows, *shifts, dtype).cpu()
    for index, row in enumerate(rows.tolist()):
        torch.testing.assert_close(ours[index], loop.observe(row, down[index], right[index]), atol=0, rtol=0)


def measure(makers: dict[str, Callable[[], object]], batches: int) -> dict[str, tuple[float, float]]:
    """Seconds of the processor and of the clock a batch, all taking turns."""
    spent = {name: (0.0, 0.0) for name in makers}
    for turn in range(batches + 1):
        for name, make in makers.items():
            clock, processor = time.perf_counter(), time.process_time()
            make()
            if turn:  # the first turn warms up
                processor, clock = time.process_time() - processor, time.perf_counter() - clock
                spent[name] = spent[name][0] + processor / batches, spent[name][1] + clock / batches
    return spent


def contestants(data: TrainingData, dtype: torch.dtype, size: int) -> dict[str, Callable[[], object]]:
    """What makes a batch, by name: the loop first, then ours."""
    generator, loop = np.random.default_rng(0), OneByOne(data, dtype)
    buffer = torch.empty((size, *loop[0][0].shape), dtype=dtype)
    items, last = iter(()), None

    def samples():
        return [loop[index] for index in generator.integers(len(loop), size=size)]

    def into_buffer():
        observations, actions = zip(*samples(), strict=True)
        return torch.stack(observations, out=buffer), torch.stack(actions)

    def loader():
        nonlocal items
        batch = next(items, None)
        if batch is None:
            items = iter(DataLoader(loop, batch_size=size, shuffle=True, drop_last=True))
            batch = next(items)
        return batch

    def ours():
        nonlocal last
        last = data.batch(size, generator, dtype=dtype, reuse=last)

    return {
        "__getitem__ loop": lambda: default_collate(samples()),
        "... into one buffer": into_buffer,
        "DataLoader over __getitem__": loader,
        "TrainingData.batch": ours,
        "... in fresh memory": lambda: data.batch(size, generator, dtype=dtype),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("release")
    parser.add_argument("--subset", help="Default: the first one.")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--batches", type=int, default=20)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, nargs="+", default=[os.cpu_count()])
    options = parser.parse_args()
    release = open_release(options.release)
    subset = release[options.subset] if options.subset else next(iter(release.subsets.values()))
    started = time.perf_counter()
    data, size = load_data([Source(subset)], device=options.device), options.batch_size
    seconds = time.perf_counter() - started
    print(f"{subset.name}: {data.frames.table.nbytes / 1e6:.0f} MB of pictures read in {seconds:.1f} s")
    for threads in options.threads:
        torch.set_num_threads(threads)
        for dtype in (torch.float32, torch.bfloat16):
            check(data, dtype)
            spent = measure(contestants(data, dtype, size), options.batches)
            loop = next(iter(spent.values()))
            print(f"\n{str(dtype).removeprefix('torch.')}, batch {size}, {threads} threads")
            print(f"{'':30s}{'CPU ms':>8s}{'clock ms':>10s}{'stacks/s':>10s}   times faster than the loop (CPU, clock)")
            for name, (processor, clock) in spent.items():
                ratios = f"{loop[0] / processor:5.1f} {loop[1] / clock:5.1f}"
                print(f"{name:30s}{1000 * processor:8.1f}{1000 * clock:10.1f}{size / clock:10,.0f}   {ratios}")
    mapped, generator = load_data([Source(subset)], memory=0), np.random.default_rng(0)
    spent = measure(
        {name: lambda d=d: d.batch(size, generator) for name, d in (("held", data), ("mapped", mapped))}, 20
    )
    print(f"\nfloat32, batch {size}, pictures held in memory or in a file that is mapped into it")
    for name, (processor, clock) in spent.items():
        share = spent["held"][1] / clock
        print(
            f"{name:30s}{1000 * processor:8.1f}{1000 * clock:10.1f}{size / clock:10,.0f}   {share:.0%} of the held rate"
        )


if __name__ == "__main__":
    main()
