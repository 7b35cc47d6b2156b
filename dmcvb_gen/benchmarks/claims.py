"""Test the paper's claims on our scores of one or more seeds.

Results that differ in nothing but the seed are taken together: the mean of all their episodes. All seeds are evaluated
from the same starts, so the standard error is that over starts, each with its mean over seeds, or that of the
seeds' means if it is larger. A difference counts from two of its standard errors on; what lies nearer is left open,
whatever its sign.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.benchmarks.profiles import budget
from dmcvb_gen.benchmarks.suites import BENCHMARKS
from dmcvb_gen.errors import DmcvbError

ERRORS = 2.0
"""Standard errors from which on a difference counts."""
NEAR = 0.05
"""BC(state) is near its data within this share of their return. The paper underlines scores within 5 % of BC(state)."""
YES, NO, OPEN = "yes", "no", "open"


@dataclass(frozen=True)
class Place:
    """Facts that results share if they differ by agent, setting or data alone."""

    benchmark: str
    task: str
    setting: str
    learns_from: str
    agent: str


@dataclass(frozen=True)
class Pooled:
    """Scores of one cell over all seeds.

    Attributes:
      mean, stderr: mean and standard error of the returns. seeds: each seed's mean.
      data: mean return of what the policy learned from.
      like_data: the policy's episodes were cut where the data's were, so that their returns can be compared.
    """

    mean: float
    stderr: float
    seeds: tuple[float, ...]
    data: float
    like_data: bool = True

    def __str__(self) -> str:
        return f"{self.mean:.1f} +- {self.stderr:.1f}"


@dataclass(frozen=True)
class Answer:
    """One claim at one place.

    Attributes:
      claim: name out of `Benchmark.claims`. where: task, data, setting, agents.
      answer: "yes", "no", or "open" where the scores do not tell.
      numbers: scores that it rests on.
    """

    claim: str
    where: str
    answer: str
    numbers: str


Scores = Mapping[Place, Pooled]


def mean_of(means: Sequence[float], stderrs: Sequence[float]) -> tuple[float, float]:
    """The mean of several scores, and its standard error; it takes the scores for independent."""
    return math.fsum(means) / len(means), math.sqrt(math.fsum(error**2 for error in stderrs)) / len(means)


def read_reports(folders: Iterable[str | Path]) -> list[dict[str, Any]]:
    """The results of reports (folders that `validate` wrote), each once.

    Raises:
      DmcvbError: there is no report, or two were made with different profiles, or one cell or subset of theirs of
        different data, or one cell was evaluated in two ways, or is there twice of one seed.
    """
    results: dict[str, dict[str, Any]] = {}
    profiles: dict[str, tuple[str | Path, dict[str, Any]]] = {}
    evaluations: dict[tuple[Place, str], dict[str, str | Path]] = {}
    data: dict[tuple[Place | str, str], set[str]] = {}
    seeds: dict[tuple[Place, int], dict[str, str | Path]] = {}
    for folder in folders:
        path = Path(folder) / "report.json"
        try:
            facts = json.loads(path.read_text())
            release = "{name} {version}".format(**facts["release"])
            if facts["results"]:
                profile = {"name": facts["profile"]["name"]} | budget(facts["profile"])
                profiles[json.dumps(profile, sort_keys=True)] = folder, profile
            for result in facts["results"]:
                results[result["fingerprint"]] = result
                place = _place(result)
                for fact, value in _evaluation(result).items():
                    evaluations.setdefault((place, fact), {})[json.dumps(value, sort_keys=True)] = folder
                data.setdefault((place, "size"), set()).add(f"{release}, {result['episodes']} episodes")
                if "digests" in result:  # those of earlier versions have none
                    digests = ", ".join(digest[:12] for digest in result["digests"].values())
                    data.setdefault((place, "digests"), set()).add(f"{release}, digest {digests}")
                # Agents, settings and shares are compared too, so a subset is to be the same everywhere.
                for subset, digest in result.get("digests", {}).items():
                    data.setdefault((subset, "digest"), set()).add(f"{subset}, digest {digest[:12]}")
                seed = result.get("seed", facts["settings"]["seed"])
                seeds.setdefault((place, seed), {})[result["fingerprint"]] = folder
        except (OSError, ValueError, KeyError, TypeError) as error:
            why = getattr(error, "strerror", None) or type(error).__name__
            raise DmcvbError(f"cannot read {path} ({why}); dmcvb-gen validate writes it") from None
    if len(profiles) > 1:
        named = _named_profiles(profiles.values())
        raise DmcvbError(f"scores of different profiles cannot be compared: {named}; ask of each apart")
    for (place, fact), values in evaluations.items():
        if len(values) > 1:
            named = ", ".join(f"{folder} ({fact} {value})" for value, folder in values.items())
            raise DmcvbError(f"{_words(place)} was evaluated in several ways: {named}; ask of each apart")
    mixed = next((names for names in data.values() if len(names) > 1), None)
    if mixed:
        raise DmcvbError(
            f"scores of one cell come from different data, so they cannot be pooled: {'; '.join(sorted(mixed))}"
        )
    twice = next(((key, named) for key, named in seeds.items() if len(named) > 1), None)
    if twice:
        ((place, seed), named) = twice
        folders = ", ".join(map(str, dict.fromkeys(named.values())))
        raise DmcvbError(f"{_words(place)} twice with seed {seed}, in {folders}; a second seed is --seed 1")
    return list(results.values())


def _evaluation(result: Mapping[str, Any]) -> dict[str, Any]:
    """Facts of a result's evaluation; results of earlier versions have the number of episodes alone."""
    return dict(result.get("evaluation", {})) | {"episodes": len(result["score"]["returns"])}


def _named_profiles(profiles: Collection[tuple[str | Path, Mapping[str, Any]]]) -> str:
    """Folders with their profiles: by name, "a (quick), b (paper)", or if names are alike by what differs."""
    every = [profile for _, profile in profiles]
    if len({profile["name"] for profile in every}) == len(every):
        return ", ".join(f"{folder} ({profile['name']})" for folder, profile in profiles)
    differ = [name for name in every[0] if any(profile.get(name) != every[0][name] for profile in every)]
    return ", ".join(f"{folder} ({', '.join(f'{n} {profile.get(n)}' for n in differ)})" for folder, profile in profiles)


def _words(place: Place) -> str:
    return f"{place.agent} on {place.task} {place.learns_from}, {place.setting}"


def pool(results: Iterable[Mapping[str, Any]]) -> dict[Place, Pooled]:
    """Results by place, those of several seeds together."""
    found: dict[Place, list[Mapping[str, Any]]] = {}
    for result in results:
        found.setdefault(_place(result), []).append(result)
    return {place: _pool(several) for place, several in found.items()}


def _place(result: Mapping[str, Any]) -> Place:
    cell = result["cell"]
    learns = cell["policy_label"] + (f" (encoder: {cell['pretrain_label']})" if cell["pretrain_label"] else "")
    return Place(cell["benchmark"], cell["task"], cell["setting"], learns, cell["agent_name"])


def _pool(results: Sequence[Mapping[str, Any]]) -> Pooled:
    returns = np.array([result["score"]["returns"] for result in results])  # (seed, start)
    seeds, starts = returns.mean(axis=1), returns.mean(axis=0)
    within = starts.std(ddof=1) / math.sqrt(len(starts)) if len(starts) > 1 else math.inf
    between = seeds.std(ddof=1) / math.sqrt(len(seeds)) if len(seeds) > 1 else 0.0
    data = float(np.mean([result["data"]["mean"] for result in results]))
    like_data = all(result["score"].get("limit") == result["data"].get("limit") for result in results)
    return Pooled(float(returns.mean()), float(max(within, between)), tuple(seeds.tolist()), data, like_data)


def answer_of(difference: float, error: float) -> str:
    """Say if a difference is above 0; it is open within two standard errors."""
    return OPEN if abs(difference) < ERRORS * error else YES if difference > 0 else NO


def above(claim: str, where: str, names: Sequence[str], scores: Sequence[Pooled]) -> Answer:
    """Say if the first of two scores is above the second."""
    (first, second), (more, less) = names, scores
    difference, error = more.mean - less.mean, math.hypot(more.stderr, less.stderr)
    numbers = f"{first} {more}, {second} {less}; difference {difference:+.1f} +- {error:.1f}"
    return Answer(claim, f"{where}, {first} over {second}", answer_of(difference, error), numbers)


def pretrained(claim: str) -> Callable[[Scores], Iterator[Answer]]:
    """Say if an encoder of other data helps: are policies on it above BC on the policy's data alone?"""

    def ask(scores: Scores) -> Iterator[Answer]:
        for place, score in scores.items():
            own, with_encoder, _ = place.learns_from.partition(" (encoder: ")
            reference = replace(place, learns_from=own, agent="bc")
            if with_encoder and reference in scores:
                names, pair = (place.agent, "bc"), (score, scores[reference])
                yield above(claim, f"{place.task} {place.learns_from}, {place.setting}", names, pair)

    return ask


def claim_words() -> dict[str, str]:
    """Claim -> its words, of all benchmarks."""
    return {name: words for one in BENCHMARKS.all().values() for name, (words, _) in one.claims.items()}


def judge(results: Iterable[Mapping[str, Any]]) -> list[Answer]:
    """All answers that results (of `report.json`, of any number of seeds) allow; those of profile smoke allow none."""
    scores = pool(result for result in results if result["profile"]["scores"])
    answers: list[Answer] = []
    for name, benchmark in BENCHMARKS.all().items():
        own = {place: score for place, score in scores.items() if place.benchmark == name}
        for _, ask in benchmark.claims.values():
            answers += ask(own)
    return answers
