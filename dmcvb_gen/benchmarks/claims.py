"""The paper's claims, tested on our scores: results of one or more seeds in, answers with their spread out.

Results that differ in nothing but the seed are taken together: the mean of all their episodes; its standard error is
that of the episodes, or of the seeds' means where these lie further apart. A difference counts from two of its
standard errors on; what lies nearer is left open, whatever its sign.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.spec import DISTRACTOR_KINDS

ERRORS = 2.0
"""Standard errors from which on a difference counts."""
NEAR = 0.05
"""Of the data's return: how near BC(state) is to it (the paper underlines what lies within 5 % of BC(state))."""
YES, NO, OPEN = "yes", "no", "open"


@dataclass(frozen=True)
class Place:
    """What results share that differ by agent, setting or data alone."""

    benchmark: str
    task: str
    setting: str
    learns_from: str
    agent: str


@dataclass(frozen=True)
class Pooled:
    """Scores of one cell over all seeds.

    Attributes:
      mean, stderr: of the returns. seeds: each seed's mean.
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
      claim: of `CLAIMS`. where: task, data, setting, agents.
      answer: "yes", "no", or "open" where the scores do not tell.
      numbers: what it rests on.
    """

    claim: str
    where: str
    answer: str
    numbers: str


Scores = Mapping[Place, Pooled]


def read_reports(folders: Iterable[str | Path]) -> list[dict[str, Any]]:
    """The results of reports (folders that `validate` wrote), each once.

    Raises:
      DmcvbError: there is no report, or two were made with different profiles, or one cell or subset of theirs of
        different data, or one cell twice of one seed.
    """
    results: dict[str, dict[str, Any]] = {}
    profiles: dict[str, str | Path] = {}
    data: dict[tuple[Place | str, str], set[str]] = {}
    seeds: dict[tuple[Place, int], dict[str, str | Path]] = {}
    for folder in folders:
        path = Path(folder) / "report.json"
        try:
            facts = json.loads(path.read_text())
            release = "{name} {version}".format(**facts["release"])
            profiles[facts["profile"]["name"]] = folder
            for result in facts["results"]:
                results[result["fingerprint"]] = result
                place = _place(result)
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
            raise DmcvbError(f"cannot read {path} ({type(error).__name__}); dmcvb-gen validate writes it") from None
    if len(profiles) > 1:
        named = ", ".join(f"{folder} ({profile})" for profile, folder in profiles.items())
        raise DmcvbError(f"scores of different profiles cannot be compared: {named}; ask of each apart")
    mixed = next((names for names in data.values() if len(names) > 1), None)
    if mixed:
        raise DmcvbError(f"scores of one cell on different data are no two seeds: {'; '.join(sorted(mixed))}")
    twice = next(((key, named) for key, named in seeds.items() if len(named) > 1), None)
    if twice:
        ((place, seed), named) = twice
        folders = ", ".join(map(str, dict.fromkeys(named.values())))
        what = f"{place.agent} on {place.task} {place.learns_from}, {place.setting}"
        raise DmcvbError(f"{what} twice with seed {seed}, in {folders}; a second seed is --seed 1")
    return list(results.values())


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
    returns = np.concatenate([result["score"]["returns"] for result in results])
    seeds = np.array([np.mean(result["score"]["returns"]) for result in results])
    within = returns.std(ddof=1) / math.sqrt(len(returns)) if len(returns) > 1 else math.inf
    between = seeds.std(ddof=1) / math.sqrt(len(seeds)) if len(seeds) > 1 else 0.0
    data = float(np.mean([result["data"]["mean"] for result in results]))
    like_data = all(result["score"].get("limit") == result["data"].get("limit") for result in results)
    return Pooled(float(returns.mean()), float(max(within, between)), tuple(seeds.tolist()), data, like_data)


def _judge(more: Pooled, less: Pooled) -> tuple[str, str]:
    """Whether the first is above the second, and the difference as text."""
    error = math.hypot(more.stderr, less.stderr)
    difference = more.mean - less.mean
    answer = OPEN if abs(difference) < ERRORS * error else YES if difference > 0 else NO
    return answer, f"{difference:+.1f} +- {error:.1f}"


def _beside(names: Sequence[str], scores: Sequence[Pooled], difference: str) -> str:
    listed = ", ".join(f"{name} {score}" for name, score in zip(names, scores, strict=True))
    return f"{listed}; difference {difference}"


def _above(claim: str, where: str, names: Sequence[str], scores: Sequence[Pooled]) -> Answer:
    """Whether the first of two scores is above the second."""
    answer, difference = _judge(*scores)
    return Answer(claim, f"{where}, {names[0]} over {names[1]}", answer, _beside(names, scores, difference))


def _with(place: Place, **others: str) -> Place:
    return Place(**{**place.__dict__, **others})


def _order(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.benchmark != "b1" or place.setting not in DISTRACTOR_KINDS[:-1]:
            continue
        later = DISTRACTOR_KINDS[DISTRACTOR_KINDS.index(place.setting) + 1 :]
        following = next((kind for kind in later if _with(place, setting=kind) in scores), None)
        if following:
            pair = (score, scores[_with(place, setting=following)])
            where = f"{place.task} {place.learns_from}, {place.agent}"
            yield _above("order", where, (place.setting, following), pair)


def _state(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.benchmark == "b1" and place.agent == "state-bc":
            within = NEAR * abs(score.data) - abs(score.mean - score.data)
            answer = OPEN if abs(within) < ERRORS * score.stderr else YES if within > 0 else NO
            numbers = f"{score}, data {score.data:.1f}; difference {score.mean - score.data:+.1f}"
            if not score.like_data:
                answer, numbers = OPEN, f"{numbers}, of episodes that were cut at other lengths"
            yield Answer("state", f"{place.task} {place.learns_from}", answer, numbers)


def _gap(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.benchmark == "b1" and place.agent == "bc":
            states = [s for p, s in scores.items() if p == _with(place, setting=p.setting, agent="state-bc")]
            if states:
                where = f"{place.task} {place.learns_from}, {place.setting}"
                yield _above("gap", where, ("BC(state)", "BC"), (states[0], score))


def _encoder(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.benchmark != "b1" or place.agent != "id+bc" or place.setting == DISTRACTOR_KINDS[0]:
            continue
        for other, beside in scores.items():
            if other.agent.startswith("state-"):
                continue
            if other == _with(place, agent=other.agent) and other.agent != place.agent:
                where = f"{place.task} {place.learns_from}, {place.setting}"
                yield _above("id", where, (place.agent, other.agent), (score, beside))


def _pretrained(benchmark: str, claim: str) -> Callable[[Scores], Iterator[Answer]]:
    def ask(scores: Scores) -> Iterator[Answer]:
        for place, score in scores.items():
            own, with_encoder, _ = place.learns_from.partition(" (encoder: ")
            reference = _with(place, learns_from=own, agent="bc")
            if place.benchmark == benchmark and with_encoder and reference in scores:
                names, pair = (place.agent, "bc"), (score, scores[reference])
                yield _above(claim, f"{place.task} {place.learns_from}, {place.setting}", names, pair)

    return ask


def _share(scores: Scores) -> Iterator[Answer]:
    groups: dict[Place, list[tuple[float, Pooled]]] = {}
    for place, score in scores.items():
        if place.benchmark == "ablations":
            share, percent, level = place.learns_from.rpartition("% ")
            key = _with(place, learns_from=level)
            groups.setdefault(key, []).append((float(share) if percent else 100.0, score))
    for place, shares in groups.items():
        for (few, less), (many, more) in itertools.pairwise(sorted(shares, key=lambda entry: entry[0])):
            where = f"{place.task} {place.learns_from}, {place.setting}, {place.agent}"
            yield _above("share", where, (f"{many:g} %", f"{few:g} %"), (more, less))


CLAIMS: dict[str, tuple[str, Callable[[Scores], Iterator[Answer]]]] = {
    "order": ("Do stronger distractors cost return (none > static > dynamic)?", _order),
    "state": ("Does BC(state) stay near its data (5 %)?", _state),
    "gap": ("Is BC(state) above BC from pictures?", _gap),
    "id": ("Does ID+BC beat the other agents under distractors and in mazes?", _encoder),
    "mixed": (
        "Does an encoder of mixed data help a policy of few episodes (B2)?",
        _pretrained("b2", "mixed"),
    ),
    "goals": (
        "Does an encoder of hidden random goals help a policy of one goal's episodes (B3)?",
        _pretrained("b3", "goals"),
    ),
    "share": ("Does more data give more return?", _share),
}
"""Claim -> its words, and who answers it at every place that the scores allow."""


def judge(results: Iterable[Mapping[str, Any]]) -> list[Answer]:
    """All answers that results (of `report.json`, of any number of seeds) allow; those of profile smoke allow none."""
    scores = pool(result for result in results if result["profile"]["scores"])
    return [answer for _, answers in CLAIMS.values() for answer in answers(scores)]


__all__ = ["CLAIMS", "Answer", "Place", "Pooled", "judge", "pool", "read_reports"]
