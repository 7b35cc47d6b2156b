"""Behavior cloning from images in a few minutes: the score of several networks, batch sizes and rates beside quick's.

    python scripts/bench_profiles.py RELEASE --subset walker-walk/expert/none --minutes 2
    python scripts/bench_profiles.py RELEASE --subset ant-maze-empty7x7/expert/visible --only quick,paper

Each variant trains as many Adam steps as it makes in the given minutes of one thread's processor time (measured
first; data are held in memory), at a rate that falls to zero, then 30 fresh episodes are scored. Printed is the score,
and its share of quick's.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import torch

from dmcvb_gen.agents.catalog import make_encoder, make_policy, parse_agent
from dmcvb_gen.agents.data import Source, load_data
from dmcvb_gen.agents.networks import NARROW, PAPER, PATCHES, Architecture
from dmcvb_gen.agents.trainer import TrainSettings, train
from dmcvb_gen.benchmarks.evaluate import Evaluator
from dmcvb_gen.benchmarks.profiles import PROFILES
from dmcvb_gen.dataset import open_release
from dmcvb_gen.loaders.painted import Painting, painted_release

WARM, TIMED = 20, 100
"""Adam steps before those that are timed, and these."""


@dataclass(frozen=True)
class Variant:
    """Settings of a training. The defaults are those of quick, whose rule decides about shifts if `shift` is None."""

    network: Architecture = PATCHES
    batch: int = 64
    rate: float = 1.0
    shift: bool | None = None
    half: bool = False
    muon: bool = True
    compiled: bool = False


VARIANTS = {
    "quick": Variant(),
    "batch 32": Variant(batch=32),
    "batch 128": Variant(batch=128),
    "half the rate": Variant(rate=0.5),
    "twice the rate": Variant(rate=2.0),
    "Adam": Variant(muon=False),
    "shifted": Variant(shift=True),
    "unshifted": Variant(shift=False),
    "narrow": Variant(NARROW),
    "narrow, unshifted": Variant(NARROW, rate=2.0, shift=False),
    "half as wide": Variant(replace(PATCHES, channels=(32, 32, 32))),
    "frames": Variant(replace(PATCHES, differences=False)),
    "64-d latent": Variant(replace(PATCHES, latent=64)),
    "GELU": Variant(replace(PATCHES, activation="gelu")),
    "bfloat16": Variant(half=True),
    "compiled": Variant(compiled=True),
    "paper": Variant(PAPER, muon=False),
}


def make(variant: Variant, data, agent):
    """A policy with the same random start for the same sizes."""
    torch.manual_seed(0)
    return make_policy(agent, make_encoder(agent, data.sizes, None, variant.network), data.sizes, variant.network)


def settings(variant: Variant, steps: int, transitions: int) -> TrainSettings:
    by_rule = PROFILES["quick"].shifts(steps * variant.batch // PROFILES["quick"].batch_size, transitions)
    return TrainSettings(
        steps=steps,
        batch_size=variant.batch,
        evaluate_every=steps,
        half=variant.half,
        compile=variant.compiled,
        rate=variant.rate,
        shift=by_rule if variant.shift is None else variant.shift,
        decay=True,
        muon=variant.muon,
    )


def steps_in(seconds: float, variant: Variant, data, agent) -> int:
    """Adam steps that a variant makes in so many seconds of the processor, which count alike on a busy machine."""
    learner = make(variant, data, agent)
    train(learner, data, settings(variant, WARM, len(data)))
    # Held-out losses are taken as seldom as in a long training.
    timed = replace(settings(variant, TIMED, len(data)), points=1)
    started = time.process_time()
    train(learner, data, timed)
    return max(1, round(TIMED * seconds / (time.process_time() - started)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("release")
    parser.add_argument("--subset", required=True)
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--only", default=",".join(VARIANTS), help=", ".join(VARIANTS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    agent = parse_agent("bc")
    subset = painted_release(open_release(options.release), Painting(), missing=True)[options.subset]
    data, quick = load_data([Source(subset)], seed=0), None
    evaluator = Evaluator(subset, normalization=data.normalization, stack=agent.stack)
    print(f"{options.subset}, {subset.returns.mean():.1f} in the data, {options.minutes:g} minutes each")
    for name in options.only.split(","):
        variant = VARIANTS[name]
        steps = steps_in(60 * options.minutes, variant, data, agent)
        learner = make(variant, data, agent)
        started = time.process_time()
        train(learner, data, settings(variant, steps, len(data)))
        cpu = time.process_time() - started
        score = evaluator(learner)
        quick = score.mean if name == "quick" else quick
        share = "" if quick is None else f", {score.mean / quick:.0%} of quick's"
        success = "" if score.success is None else f", success {score.success:.0%}"
        print(
            f"{name:>15}: {score.mean:7.1f} +- {score.stderr:5.1f}{share}{success}; {steps} steps, "
            f"{steps * variant.batch / cpu:.0f} samples/s of processor time",
            flush=True,
        )
    evaluator.close()


if __name__ == "__main__":
    main()
