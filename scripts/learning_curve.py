"""The return of one agent along a long training, as a table and a picture.

    python scripts/learning_curve.py RELEASE --subset cheetah-run/expert/none --scale 18 --folder runs/cheetah-curve
    python scripts/learning_curve.py RELEASE --subset cheetah-run/expert/none --profile paper --folder runs/paper-cell
    python scripts/learning_curve.py RELEASE --subset cheetah-run/expert/none --set muon=false --folder runs/adam

On a GPU, the paper's cell takes minutes:

    python scripts/learning_curve.py RELEASE --subset cheetah-run/expert/none --profile paper --folder F
        --device cuda --precision bfloat16 --compile --scores 40 --beside 10

The agent trains as in `validate` with that profile, `--scale` times as long, on one thread or a GPU. It is scored on 30
fresh episodes at even distances, and each score is printed. With --beside, other processes score it on the CPU while
it trains on. Images that the release does not store are painted. A stopped training goes on if the command is given
again. At the end the folder has curve.csv and curve.png.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from safetensors.torch import load_file, save_file

from dmcvb_gen.agents.catalog import Agent, make_encoder, make_policy, parse_agent
from dmcvb_gen.agents.data import Normalization, Sizes, Source, TrainingData, load_data
from dmcvb_gen.agents.learners import Policy
from dmcvb_gen.agents.trainer import TrainSettings, train
from dmcvb_gen.benchmarks.evaluate import Evaluator, Score
from dmcvb_gen.benchmarks.profiles import PROFILES, Profile, budget, facts_of, get_profile
from dmcvb_gen.dataset import Subset, open_release
from dmcvb_gen.dataset.writer import subset_digest
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.loaders.painted import Painting, painted_release
from dmcvb_gen.progress import ProgressBar

READ = (
    *("pixel_steps", "state_steps", "batch_size", "state_batch_size", "rate", "shift_from", "decay", "muon"),
    "episode_steps",
)
"""Fields of a profile that decide this training, and that --set changes."""
COLUMNS = ("step", "seconds", "loss", "test_loss", "return", "error")


@dataclass(frozen=True)
class Scene:
    """An agent and the subset that it learns from; another process can score its weights by these."""

    release: str
    subset: str
    agent: Agent
    profile: Profile
    precision: str

    @property
    def half(self) -> bool:
        return self.precision == "bfloat16" and not self.agent.sees_state  # as in `validate`

    def open(self) -> Subset:
        """The subset; if the agent sees pictures, those that it does not store are painted."""
        release = open_release(self.release)
        if not self.agent.sees_state:
            release = painted_release(release, Painting(), missing=True)
        return release[self.subset]

    def policy(self, sizes: Sizes) -> Policy:
        """An untrained policy."""
        network = self.profile.network
        return make_policy(self.agent, make_encoder(self.agent, sizes, None, network), sizes, network)

    def evaluator(self, subset: Subset, normalization: Normalization, **options) -> Evaluator:
        """30 fresh episodes."""
        return Evaluator(
            subset,
            pixels=not self.agent.sees_state,
            normalization=normalization,
            stack=self.agent.stack,
            episodes=30,
            max_steps=self.profile.episode_steps,
            **options,
        )

    def score(self, sizes: Sizes, normalization: Normalization, weights: Path) -> dict[str, float]:
        """The return of stored weights, written beside them too."""
        torch.set_num_threads(1)
        policy = self.policy(sizes)
        policy.load_state_dict(load_file(weights))
        policy.half = self.half
        evaluator = self.evaluator(self.open(), normalization)
        found = points_of(evaluator(policy))
        evaluator.close()
        weights.with_suffix(".json").write_text(json.dumps(found) + "\n")
        return found


def points_of(score: Score) -> dict[str, float]:
    """A score's columns of the curve."""
    return {"return": score.mean, "error": score.stderr}


class ScoresBeside:
    """Scores a policy in other processes while it trains on; its weights wait in a folder.

    Args:
      say: called with a number of steps and their score, when it is there.
    """

    def __init__(self, scene: Scene, data: TrainingData, folder: Path, processes: int, say: Callable):
        self._scene, self._of_data, self._folder, self._say = scene, (data.sizes, data.normalization), folder, say
        self._pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))
        self._scores: dict[int, Future] = {}
        folder.mkdir(parents=True, exist_ok=True)
        for weights in sorted(folder.glob("*.safetensors")):  # of an earlier start
            if not weights.with_suffix(".json").exists():
                self._submit(int(weights.stem), weights)

    def __call__(self, policy: Policy, step: int) -> None:
        weights = self._folder / f"{step}.safetensors"
        save_file({name: value.cpu().contiguous() for name, value in policy.state_dict().items()}, weights)
        self._submit(step, weights)

    def _submit(self, step: int, weights: Path) -> None:
        self._scores[step] = self._pool.submit(self._scene.score, *self._of_data, weights)
        self._scores[step].add_done_callback(lambda done: done.exception() or self._say(step, done.result()))

    def finish(self) -> dict[int, dict[str, float]]:
        """Step -> its score, of all that are stored."""
        for score in self._scores.values():
            score.result()
        self._pool.shutdown()
        return {int(path.stem): json.loads(path.read_text()) for path in self._folder.glob("*.json")}


def write_curve(folder: Path, points: list[dict], of_data: float) -> None:
    """Write curve.csv and curve.png of the scored points."""
    with open(folder / "curve.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(points)
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    minutes = [point["seconds"] / 60 for point in points]
    axes.errorbar(minutes, [p["return"] for p in points], [p["error"] for p in points], marker="o", label="agent")
    axes.axhline(of_data, color="gray", linestyle="--", label="data")
    axes.set(xlabel="minutes, evaluations included", ylabel="return")
    if of_data > 0:
        axes.set_ylim(bottom=0)
    axes.legend()
    figure.savefig(folder / "curve.png", dpi=120)
    plt.close(figure)


def keep_options(
    options: argparse.Namespace, subset: Subset, profile: Profile, parser: argparse.ArgumentParser
) -> None:
    """Write the options, the data's digest and the profile's values into the folder; refuse one that has others."""
    asked: dict = {name: str(value) for name, value in vars(options).items() if name != "folder"}
    asked |= {"digest": subset_digest(subset.commits), "values": budget(facts_of(profile))}
    path = options.folder / "options.json"
    if path.exists():
        kept = json.loads(path.read_text())
        kept |= {"values": budget(kept["values"])} if "values" in kept else {}
        other = [name for name in kept if kept[name] != asked.get(name)]  # an earlier version kept fewer
        if other:
            what = "data" if other == ["digest"] else f"options ({', '.join(other)})"
            parser.error(f"{options.folder} holds a training with other {what}, see {path}; choose another --folder")
        return
    options.folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(asked, indent=1) + "\n")


def change(profile: Profile, pairs: list[str], parser: argparse.ArgumentParser) -> Profile:
    """The profile with other values of numbers and switches; refuse what it has no such field for."""
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            value = json.loads(text)
        except ValueError:
            value = None
        kinds = {field: type(getattr(profile, field)) for field in READ} | {"episode_steps": int}  # None: whole ones
        right = (bool,) if kinds.get(name) is bool else (int, float)
        if name not in kinds or type(value) not in right:
            parser.error(f"--set {pair}: give FIELD=VALUE, e.g. muon=false; fields are {', '.join(kinds)}")
        profile = replace(profile, **{name: kinds[name](value)})
    return profile


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("release")
    parser.add_argument("--subset", required=True)
    parser.add_argument("--folder", type=Path, required=True, help="Where the training and its curve are kept.")
    parser.add_argument("--agent", default="bc", help="bc, td3-bc, state-bc, state-td3-bc, …")
    parser.add_argument("--profile", default="quick", choices=list(PROFILES))
    parser.add_argument("--scale", type=float, default=1.0, help="Times the profile's steps.")
    parser.add_argument("--scores", type=int, default=12, help="Evaluations along the training.")
    parser.add_argument("--precision", default="float32", choices=["float32", "bfloat16"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--threads", type=int, default=1, help="Threads of the training; scores in turn take as many.")
    parser.add_argument("--beside", type=int, default=0, metavar="N", help="Score in N processes beside the training.")
    parser.add_argument("--compile", action="store_true", help="Use torch.compile.")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE", help=f"Of {', '.join(READ)}.")
    options = parser.parse_args()
    for name, least in {"scores": 1, "threads": 1, "beside": 0, "seed": 0}.items():
        if getattr(options, name) < least:
            parser.error(f"--{name} is {getattr(options, name)}; give {least} or more")
    if not options.scale > 0:
        parser.error(f"--scale is {options.scale}; give more than 0")
    torch.set_num_threads(options.threads)
    profile = change(get_profile(options.profile), options.set, parser).scaled(options.scale)
    try:
        agent = parse_agent(options.agent)
    except DmcvbError as error:
        parser.error(str(error))
    if agent.own or agent.pretrain:
        parser.error("--agent: one that trains its own encoder, or state-bc or state-td3-bc")
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device: this torch finds no CUDA device; install a CUDA build of torch")
    scene = Scene(options.release, options.subset, agent, profile, options.precision)
    try:
        subset = scene.open()
    except DmcvbError as error:
        parser.error(str(error))
    keep_options(options, subset, profile, parser)  # after what may refuse them
    pixels = not agent.sees_state
    chosen = {"pixels": pixels, "seed": options.seed, "stack": agent.stack, "device": options.device}
    with ProgressBar(pixels, total=100, unit=" %", desc="images") as bar:
        data = load_data([Source(subset)], **chosen, tick=lambda share: bar.update(int(100 * share) - bar.n))
    torch.manual_seed(options.seed)
    learner = scene.policy(data.sizes).to(options.device)
    done = [0]

    def count(steps: int) -> None:
        done[0] += steps
        bar.update(steps)

    def say(step: int, score: dict[str, float]) -> None:
        of = f"{step:>9,} of {settings.steps:,} steps"
        print(f"{of}: {score['return']:7.1f} +- {score['error']:.1f}", flush=True)

    evaluator = beside = None
    if options.beside:
        beside = ScoresBeside(scene, data, options.folder / "scores", options.beside, say)
    else:
        evaluator = scene.evaluator(subset, data.normalization, device=options.device, threads=options.threads)

    def evaluate(policy: Policy) -> dict[str, float]:
        if beside:
            beside(policy, done[0])
            return {}
        score = points_of(evaluator(policy))
        say(done[0], score)
        return score

    steps = profile.pixel_steps if pixels else profile.state_steps
    steps = -(-steps // options.scores) * options.scores  # so that the last score is of a whole stretch
    settings = TrainSettings(
        steps=steps,
        batch_size=profile.batch_size if pixels else profile.state_batch_size,
        evaluate_every=steps // options.scores,
        points=options.scores,
        half=scene.half,
        rate=profile.rate if pixels else 1.0,
        shift=profile.shifts(steps, len(data)),
        decay=profile.decay,
        muon=pixels and profile.muon,
        compile=options.compile,
        workers=0 if options.device == "cpu" else 1,
    )
    with ProgressBar(total=steps, unit=" steps", desc="training") as bar:
        curve = train(learner, data, settings, seed=options.seed, folder=options.folder, evaluate=evaluate, tick=count)
    if beside:
        scores = beside.finish()
        curve = [point | scores.get(point["step"], {}) for point in curve]
    else:
        evaluator.close()
    write_curve(options.folder, [point for point in curve if "return" in point], float(subset.returns.mean()))


if __name__ == "__main__":
    main()
