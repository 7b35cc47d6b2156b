"""Adam steps a second of every agent's learners: float32, bfloat16, and compiled.

python scripts/bench_agents.py --steps 10 --agents bc,id+bc,state-bc --batch-size 64 --network patches --threads 1
python scripts/bench_agents.py --device cuda --compile --memory

Data are random, of walker's sizes (9 channels, 64 x 64, 24 states, 6 actions); drawing the batches is in the time.
"""

from __future__ import annotations

import argparse
import os
import time

import numpy as np
import torch

from dmcvb_gen.agents.catalog import make_encoder, make_policy, make_pretrainer, parse_agent
from dmcvb_gen.agents.data import PAD, TrainingData
from dmcvb_gen.agents.networks import NETWORKS, encoder_product
from dmcvb_gen.agents.trainer import TrainSettings, train
from dmcvb_gen.dataset.steps import StepTable
from dmcvb_gen.precision import choose_precision

AGENTS = "state-bc,state-td3-bc,bc,td3-bc,id+bc,lfd+bc,ae+bc,state+bc"


def random_data(device: str, episodes: int = 4, steps: int = 500, size: int = 64) -> TrainingData:
    """Episodes of noise."""
    rows, generator = episodes * (steps + 1), np.random.default_rng(0)
    fields = {
        "state": generator.standard_normal((rows, 24), np.float32),
        "action": generator.random((rows, 6), np.float32) * 2 - 1,
        "reward": generator.random(rows, np.float32),
        "discount": np.ones(rows, np.float32),
    }
    frames = generator.integers(256, size=(rows, 3, size, size + 2 * PAD), dtype=np.uint8)
    table = StepTable(fields, np.full(episodes, steps), frames)
    return TrainingData(table, np.zeros(episodes, bool), device=device)


def steps_per_second(learner, data: TrainingData, options, half: bool, compiled: bool) -> float:
    """Steps a second after warming up (and compiling)."""
    settings = dict(batch_size=options.batch_size, points=1, half=half, workers=options.workers)
    train(learner, data, TrainSettings(steps=3, compile=compiled, **settings))
    if options.device == "cuda":
        torch.cuda.synchronize()
    started = time.perf_counter()
    train(learner, data, TrainSettings(steps=options.steps, **settings))
    if options.device == "cuda":
        torch.cuda.synchronize()
    return options.steps / (time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", default=AGENTS)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--network", default="paper", choices=list(NETWORKS))
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--workers", type=int, default=0, help="Threads that draw batches ahead.")
    parser.add_argument("--compile", action="store_true", help="Measure torch.compile too (takes minutes on a CPU).")
    parser.add_argument("--memory", action="store_true", help="Print the accelerator's peak memory.")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    data = random_data(options.device)
    how = f"{options.threads} threads, batch {options.batch_size}, {options.network} network"
    print(f"torch {torch.__version__}, {options.device}, {how}")
    auto = choose_precision("auto", encoder_product(NETWORKS[options.network]), options.device)
    print(
        f"networks that see pictures: `--precision auto` takes {auto} here; agents that see states compute in float32"
    )
    print(f"{'learner':34s} {'float32':>9s} {'bfloat16':>9s} {'compiled':>9s}  Adam steps/s (best against float32)")
    for name in options.agents.split(","):
        agent = parse_agent(name)
        seen = data.states_only() if agent.sees_state else data
        parts = [("pre-training", make_pretrainer)] if agent.pretrain else []
        network = NETWORKS[options.network]
        for part, make in [*parts, ("policy", make_policy)]:
            rates = []
            for half, compiled in [(False, False), (True, False)] + [(not agent.sees_state, True)] * options.compile:
                torch.manual_seed(0)
                encoder = make_encoder(agent, seen.sizes, architecture=network).to(options.device)
                learner = make(agent, encoder, seen.sizes, network).to(options.device)
                rates.append(steps_per_second(learner, seen, options, half, compiled))
            shown = "".join(f" {rate:9.2f}" for rate in rates) + " " * 10 * (3 - len(rates))
            print(f"{f'{name}, {part}':34s}{shown}  {max(rates) / rates[0]:.2f} x", flush=True)
    if options.memory and options.device == "cuda":
        print(f"peak memory: {torch.cuda.max_memory_allocated() / 1e9:.2f} GB")


if __name__ == "__main__":
    main()
