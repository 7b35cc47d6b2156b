"""A leaderboard that anyone can recompute: a folder of rows, one JSON file and at most one policy file each.

    docs/leaderboard/<row>.json         score, command, seed, digests, version, processor (`Row`)
    docs/leaderboard/<row>.safetensors  the policy, which `check_row` evaluates again

Rows come from reports of `validate`; the page is written from the rows alone.
"""

from __future__ import annotations

import json
import math
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from dmcvb_gen.benchmarks.suites import slug
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.files import copy_file, sha256_file, write_json, write_text
from dmcvb_gen.generate.recipe import shipped_recipes
from dmcvb_gen.text import quoted

ERRORS = 3.0
"""Standard errors, the row's or the difference's, that a score may move by when it is computed again."""


class Release(BaseModel):
    """The release that an agent learned from.

    Attributes:
      digest: root digest, which names every byte of it. command: that makes it.
    """

    name: str
    version: str
    digest: str
    command: str


class Evaluation(BaseModel):
    """Details of the evaluation beside the protocol of `validate`.

    Attributes:
      episodes: 30 by that protocol. steps: agent steps of an episode at most. seed: of starts and distractors.
      size, renderer, samples, backgrounds: of the pictures, and the digest of the videos; None for states.
    """

    episodes: int
    steps: int
    seed: int = 0
    size: int | None = None
    renderer: str | None = None
    samples: int | None = None
    backgrounds: str | None = None


class Row(BaseModel):
    """A row of the leaderboard.

    Attributes:
      agent: e.g. "state-bc". trained: profile of its training. seed: of its training.
      task, setting: those of the evaluation. data: level that it learned from. data_episodes: their number.
      data_return: their mean return. paper: the paper's mean score of that agent on a million steps, if it has one.
      command: that made the score, run beside the release. made: date. generator: version. processor, precision: that
        trained it.
      returns: return of each evaluation episode.
      policy: SHA-256 of the policy file beside the row; None if there is none.
    """

    model_config = ConfigDict(extra="forbid")

    format: Literal["dmcvb-gen leaderboard row"] = "dmcvb-gen leaderboard row"
    agent: str
    trained: str
    seed: int
    task: str
    setting: str
    data: str
    data_episodes: int
    data_return: float
    paper: float | None
    release: Release
    command: str
    made: str
    generator: str
    processor: str
    precision: str
    evaluation: Evaluation
    returns: tuple[FiniteFloat, ...] = Field(min_length=1)
    policy: str | None

    @model_validator(mode="after")
    def _counted(self) -> Row:
        if len(self.returns) != self.evaluation.episodes:
            raise ValueError(f"{len(self.returns)} returns of {self.evaluation.episodes} episodes")
        return self

    @property
    def name(self) -> str:
        """File name: different for every agent, data, training and seed."""
        parts = (self.task, self.setting, self.agent, self.data, self.trained, self.release.name, f"seed{self.seed}")
        return "_".join(slug(part) for part in parts)

    @property
    def mean(self) -> float:
        return sum(self.returns) / len(self.returns)

    @property
    def stderr(self) -> float:
        """Standard error of the mean, with n - 1."""
        return _stderr(self.returns)


def _stderr(returns: Sequence[float]) -> float:
    count, mean = len(returns), sum(returns) / len(returns)
    return math.sqrt(sum((value - mean) ** 2 for value in returns) / max(1, count - 1) / count)


def read_rows(folder: str | Path, names: Sequence[str] = ()) -> list[Row]:
    """The rows of a folder by task, setting and falling score.

    Args:
      names: only these.

    Raises:
      DmcvbError: the folder is not there, or a file is no row. UnknownNameError: no row has that name.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DmcvbError(
            f"there is no folder {folder}; `dmcvb-gen leaderboard {quoted(folder)} --add REPORT` begins one"
        )
    rows = {path.stem: _read_row(path) for path in sorted(folder.glob("*.json"))}
    for name in names:
        if name not in rows:
            raise UnknownNameError("row", name, rows)
    chosen = [row for name, row in rows.items() if not names or name in names]
    return sorted(chosen, key=lambda row: (row.task, row.setting, -row.mean, row.name))


def _read_row(path: Path) -> Row:
    try:
        row = Row.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise DmcvbError(f"{path} is no row of a leaderboard ({reason})") from None
    if row.name != path.stem:
        raise DmcvbError(f"{path} is the row {row.name}; rename it")
    return row


# -- rows out of reports --------------------------------------------------------------------------


def rows_of_report(report: str | Path, data_command: str = "") -> dict[str, tuple[Row, Path | None]]:
    """Rows of a report's cells: name -> (row, policy file if it was kept).

    Args:
      report: the folder that `validate` wrote.
      data_command: makes the release; by default `rollout` with its recipe's name, if the package has that recipe.

    Raises:
      DmcvbError: there is no report, its scores are noise, the release is not complete, nothing says how it was made,
        or it has no cell that can be evaluated by its name alone; a policy file is another run's.
    """
    folder = Path(report)
    try:
        facts = json.loads((folder / "report.json").read_text())
        return _rows_of_facts(facts, folder, data_command)
    except DmcvbError:
        raise
    except (OSError, ValueError) as error:
        raise DmcvbError(f"{folder} holds no report of validate ({error})") from None
    except (AttributeError, LookupError, TypeError) as error:
        why = f"{type(error).__name__}: {error}"
        raise DmcvbError(f"{folder} holds no report of this version's validate ({why}); run validate again") from None


def _rows_of_facts(facts: dict[str, Any], folder: Path, data_command: str) -> dict[str, tuple[Row, Path | None]]:
    if not facts["profile"]["scores"]:
        raise DmcvbError(f"{folder}: scores of profile {facts['profile']['name']} are noise; use brief, quick or paper")
    release = facts["release"]
    if not release.get("digest"):
        raise DmcvbError(f"{folder}: its release has no root digest; finish the release and run validate again")
    if not facts["complete"] or not facts["structure"]["sound"]:
        raise DmcvbError(f"{folder}: its release was not whole and sound; fetch or repair it and run validate again")
    command = data_command or _rollout_of(release)
    made_of = Release(**{key: release[key] for key in ("name", "version", "digest")}, command=command)
    entries = [
        (_row_of(result, facts, made_of), _policy_of(result, folder))
        for result in facts["results"]
        if result.get("evaluation") and result["evaluation"]["goals"] is None
    ]
    if not entries:
        raise DmcvbError(f"{folder} holds no cell that can be evaluated again; B3's goals are a release's own")
    rows: dict[str, tuple[Row, Path | None]] = {}
    for row, path in entries:  # a cell of several benchmarks is one row: the first that the paper has, too
        if row.name not in rows or (row.paper is not None and rows[row.name][0].paper is None):
            rows[row.name] = (row, path)
    return rows


def _rollout_of(release: dict[str, Any]) -> str:
    """The command that makes a release of a shipped recipe.

    Raises:
      DmcvbError: the package has no such recipe.
    """
    name = release["name"]
    if name not in shipped_recipes():
        raise DmcvbError(f"no recipe of the package is called {name}; give the command that made it by --data-command")
    return shlex.join(
        ["dmcvb-gen", "rollout", "--recipe", name, *([] if release.get("pixels", True) else ["--no-pixels"])]
    )


def _policy_of(result: dict[str, Any], report: Path) -> Path | None:
    """The policy file of a report's cell, None if it is not there.

    Raises:
      DmcvbError: it is that of another run into the same folder.
    """
    path = report / "cells" / f"{result['id']}.safetensors"
    if not path.exists():
        return None
    if sha256_file(path) != result.get("policy_file"):
        raise DmcvbError(
            f"{path} is not the policy that {report / 'report.json'} scored; run its validate again, or remove the "
            "file to make a row without policy"
        )
    return path


def _row_of(result: dict[str, Any], facts: dict[str, Any], release: Release) -> Row:
    cell, evaluation, score = result["cell"], result["evaluation"], result["final"]
    renderer = evaluation.get("renderer") or {}
    data = cell["policy_label"] + (f" (encoder: {cell['pretrain_label']})" if cell["pretrain_label"] else "")
    return Row(
        agent=cell["agent_name"],
        trained=result["profile"]["name"],
        seed=result["seed"],
        task=cell["task"],
        setting=cell["setting"],
        data=data,
        data_episodes=result["episodes"],
        data_return=result["data"]["mean"],
        paper=result["paper"] and result["paper"]["mean"],
        release=release,
        command=_command(result, facts),
        made=facts["made"][:10],
        generator=result["generator"],
        processor=facts["versions"]["cpu"],
        precision="float32" if cell["agent"]["sees_state"] else result["machine"]["precision"],
        evaluation=Evaluation(
            episodes=len(score["returns"]),
            steps=evaluation["steps"],
            size=evaluation.get("size"),
            renderer=renderer.get("name"),
            samples=renderer.get("samples"),
            backgrounds=evaluation.get("backgrounds"),
        ),
        returns=score["returns"],
        policy=None,
    )


def _command(result: dict[str, Any], facts: dict[str, Any]) -> str:
    """The command that trains and scores a cell, run beside its release; FOLDER and FILE stand for a user's own."""
    cell, machine = result["cell"], result["machine"]
    subsets = dict.fromkeys(part["subset"] for part in (*cell["pretrain"], *cell["policy"]))
    profile, _, scale = result["profile"]["name"].partition(" x")
    words = ["dmcvb-gen", "validate", f"releases/{facts['release']['name']}", "--profile", profile]
    words += ["--scale", scale] if scale else []
    words += ["--benchmark", cell["benchmark"], "--agents", cell["agent_name"]]
    if cell["agent"]["own"]:
        words[-2:] = ["--agent", cell["agent_name"], "--agents", "state-bc"]
    words += [word for subset in subsets for word in ("--only", subset)]
    words += ["--seed", str(result["seed"]), "--precision", machine["precision"]]
    if (videos := result["evaluation"].get("backgrounds")) and videos != _builtin_videos():
        words += ["--backgrounds", "FOLDER"]
    if cell["agent"]["pretrain"] == "dino":
        words += ["--dino-weights", "FILE"]
    return shlex.join(words)


def _builtin_videos() -> str:
    """Digest of the package's own videos of the evaluation."""
    from dmcvb_gen.benchmarks.evaluate import SPLIT
    from dmcvb_gen.distractors import load_backgrounds

    return load_backgrounds("builtin", SPLIT).digest


def add_rows(folder: str | Path, rows: dict[str, tuple[Row, Path | None]]) -> list[Row]:
    """Write rows with their policy files into a folder; a row of that name is replaced. Gives them as written."""
    folder, written = Path(folder), []
    folder.mkdir(parents=True, exist_ok=True)
    for name, (row, policy) in rows.items():
        kept = folder / f"{name}.safetensors"
        if policy:
            copy_file(policy, kept)
            row = row.model_copy(update={"policy": sha256_file(kept)})
        else:
            kept.unlink(missing_ok=True)
        write_json(folder / f"{name}.json", row.model_dump(mode="json"))
        written.append(row)
    return written


# -- rows computed again --------------------------------------------------------------------------


@dataclass(frozen=True)
class Check:
    """A row and its score, computed again.

    Attributes:
      returns: return of each episode, now; empty if there is no policy file.
      holds: True if the score is the row's within three standard errors; None if it cannot be computed.
      why: reason in words.
    """

    row: Row
    returns: tuple[float, ...]
    holds: bool | None
    why: str


def check_row(folder: str | Path, row: Row, evaluate: Callable[..., Any] | None = None) -> Check:
    """Evaluate the policy of a row again: same starts, same distractors.

    Networks do not give the same bits on every processor, and episodes fall apart from the last bit on, so equal
    returns are not asked for.

    Args:
      evaluate: in place of `dmcvb_gen.evaluate`.

    Raises:
      DmcvbError: the policy file is missing or another one, or this version cannot run the row's evaluation.
    """
    from dmcvb_gen.benchmarks import evaluate as evaluation
    from dmcvb_gen.benchmarks.trained import load_agent

    if row.policy is None:
        return Check(row, (), None, f"no policy file; train it: {row.command}")
    path = Path(folder) / f"{row.name}.safetensors"
    if not path.exists() or sha256_file(path) != row.policy:
        raise DmcvbError(f"{path} is not the row's policy file (SHA-256 {row.policy[:16]}...); get it again")
    how, agent = row.evaluation, load_agent(path)
    if how.backgrounds and how.backgrounds != _builtin_videos():
        raise DmcvbError(f"{row.name} was evaluated with videos of its own, which this package does not have")
    pictures = dict(size=how.size, renderer=how.renderer, samples=how.samples) if agent.pixels else {}
    limits = dict(episodes=how.episodes, seed=how.seed, max_steps=how.steps)
    score = (evaluate or evaluation.evaluate)(
        agent, f"{row.task}/{row.setting}", pixels=agent.pixels, stack=agent.stack, **limits, **pictures
    )
    if score.returns == row.returns:
        return Check(row, score.returns, True, "the same returns to the last bit")
    moved = [now - then for now, then in zip(score.returns, row.returns, strict=True)]
    difference, error = sum(moved) / len(moved), _stderr(moved)
    beside = f"{score.mean:.1f} now, {row.mean:.1f} +- {row.stderr:.1f} in the row"
    why = f"{beside}; moved by {difference:+.1f} +- {error:.1f}"
    return Check(row, score.returns, abs(difference) <= ERRORS * max(error, row.stderr), why)


# -- the page -------------------------------------------------------------------------------------


def render_page(
    rows: Sequence[Row], title: str = "Leaderboard", folder: str = "docs/leaderboard", links: str = "leaderboard"
) -> str:
    """The page of some rows, as Markdown: a table for each task and setting, and the commands below it.

    Args:
      folder: the rows' folder, for commands. links: the same as seen from the page.
    """
    source = resources.files("dmcvb_gen.benchmarks").joinpath("data/leaderboard.md.jinja").read_text()
    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(f"{row.task}/{row.setting}", []).append(row)
    return environment.from_string(source).render(
        title=title, groups=groups, folder=shlex.quote(folder), links=quote(links)
    )


def write_page(path: str | Path, rows: Sequence[Row], folder: str | Path) -> None:
    """Write `render_page` of a folder's rows into a file."""
    links = os.path.relpath(folder, Path(path).parent)
    write_text(Path(path), render_page(rows, folder=str(folder), links=Path(links).as_posix()))
