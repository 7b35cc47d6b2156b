"""Find the policy files of a level: the package's own by default, or those of a file or run."""

from __future__ import annotations

import contextlib
import functools
import logging
import re
import zipfile
from pathlib import Path

from dmcvb_gen.errors import DmcvbError, PolicyFileError
from dmcvb_gen.files import parse_json
from dmcvb_gen.own_code import is_own, leave_of
from dmcvb_gen.policies.archives import bundled_digests, bundled_file
from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.spec import TRAINED_LEVELS, MazeName, is_maze, task_folder
from dmcvb_gen.text import quoted

CONVERTED = (".zip", ".pt", ".pth", ".cleanrl_model")
"""Files of other programs' policies, which are converted: Stable-Baselines3's, torch's and CleanRL's."""
log = logging.getLogger(__name__)

_MIXED = re.compile(r"mixed_([0-9]+)\.safetensors")


def level_files(folder: Path, level: str) -> list[Path]:
    """The policy files of a level in a folder, in order; empty if there are none.

    The files of mixed are numbered. A file of another name, such as mixed_final, is left out.
    """
    if level == "mixed":
        named = ((_MIXED.fullmatch(path.name), path) for path in folder.glob("mixed_*.safetensors"))
        return [path for _, _, path in sorted((int(found[1]), path.name, path) for found, path in named if found)]
    path = folder / f"{level}.safetensors"
    return [path] if path.exists() else []


def bundled_names(task_id: str, level: str) -> list[str]:
    """Names of the bundled policy files of a task and level, in order: <task>/expert.safetensors, for example."""
    start = f"{task_id}/mixed_" if level == "mixed" else f"{task_id}/{level}.safetensors"
    return sorted(name for name in bundled_digests() if name.startswith(start))


def bundled_levels(task_id: str) -> list[str]:
    """Levels that the package has policies for."""
    return [level for level in TRAINED_LEVELS if bundled_names(task_id, level)]


def bundled_policies(task_id: str, level: str) -> list[Path]:
    """Bundled policy files of a task and level (eight for mixed).

    Raises:
      DmcvbError: the package has none (says how to get one), or no folder to unpack them into can be written.
    """
    names, maze = bundled_names(task_id, level), MazeName.parse(task_id)
    if not names:
        have = ", ".join([*bundled_levels(task_id), "random"])
        train, run = f"dmcvb-gen train-behaviour {quoted(task_id)}", quoted(f"runs/{task_id}")
        train += f"{' --algo guided' * bool(maze)} && {leave_of(task_id)}dmcvb-gen select-checkpoints {run}"
        if maze and maze.rows:
            train, run = f"dmcvb-gen train-behaviour {maze.layout}.txt", f"runs/{maze.layout}"
        raise DmcvbError(
            f"no {level} policy of {task_folder(task_id)} is bundled (there is: {have}); train one with `{train}`, "
            f"then give --behaviour {run}"
        )
    return [bundled_file(name) for name in names]


def levels_of(behaviour: str | Path) -> list[str]:
    """Levels that a run folder or a folder of level files has policies for; a single policy file's own level.

    Raises:
      PolicyFileError: there are none, or no such file or folder.
    """
    path = checkpoint_of(behaviour) or Path(behaviour)
    if path.is_file():
        from dmcvb_gen.policies.policy_file import read_header  # loads numba, which listing needs not

        level = read_header(path).level or path.stem
        return ["expert" if level == "random" else level]  # which would have no policy
    for folder in (path / "selected", path):
        if levels := [level for level in TRAINED_LEVELS if level_files(folder, level)]:
            return levels
    raise _nothing_in(path, None)


def check_level(path: Path, header: PolicyHeader, level: str) -> None:
    """Raise PolicyFileError if a policy is of another level than the one that was asked for."""
    if header.level not in (None, level):
        raise PolicyFileError(f"{path} is a policy of level {header.level}, not {level}; ask for that --level")


def checkpoints(run: str | Path) -> dict[int, Path]:
    """Agent step -> checkpoint of a run."""
    files = Path(run, "checkpoints").glob("[0-9]*.safetensors")
    return {int(path.stem): path for path in files if path.stem.isdecimal()}


def checkpoint_of(behaviour: str | Path) -> Path | None:
    """The checkpoint that RUN@latest or RUN@STEP names; None of a name of another form.

    Raises:
      PolicyFileError: the run has no such checkpoint.
    """
    run, _, asked = str(behaviour).rpartition("@")
    if not Path(run, "checkpoints").is_dir() or not run or Path(behaviour).exists():
        return None
    files = checkpoints(run)
    if not files:
        raise PolicyFileError(f"{run} has no checkpoint yet; train it longer")
    if asked == "latest":
        _tell(f"{behaviour} is the checkpoint of agent step {max(files):,}.")
        return files[max(files)]
    step = int(asked) if asked.isdecimal() else -1
    if step not in files:
        near = sorted(sorted(files, key=lambda known: abs(known - step))[:3])
        raise PolicyFileError(f"{run} has no checkpoint {asked!r}; give latest, or an agent step such as {near}")
    return files[step]


@functools.cache
def _tell(message: str) -> None:
    log.warning(message)


def is_foreign(path: Path) -> bool:
    """Return True for a file of another program's policy; SB3 adds no .zip to a name that has a dot."""
    return path.is_file() and (path.suffix in CONVERTED or zipfile.is_zipfile(path))


def resolve_policies(task_id: str, level: str, behaviour: str | Path | None = None) -> list[Path]:
    """Policy files of a level: bundled ones, or those of `behaviour`.

    Args:
      behaviour: a policy file, another program's (`policies.convert`), a run folder in which checkpoints were selected,
        RUN@latest or RUN@STEP for one checkpoint of a run, a folder of level files, or "<module>:<function>".

    Raises:
      DmcvbError: there is nothing for that level.
    """
    if level == "mixed" and is_maze(task_id):
        raise DmcvbError("mazes have no mixed policies, as in the paper; ask for expert or medium")
    if behaviour is None:
        return bundled_policies(task_id, level)
    path = checkpoint_of(behaviour) or Path(behaviour)
    if is_foreign(path):
        from dmcvb_gen.policies.convert import converted

        return [converted(path, task_id, level)]
    if path.is_file() or is_own(str(behaviour)):
        return [path]
    for folder in (path / "selected", path):
        if files := level_files(folder, level):
            return files
    raise _nothing_in(path, level)


def _nothing_in(path: Path, level: str | None) -> PolicyFileError:
    """Why a path has no policy of a level, or of any."""
    if not path.is_dir():
        return PolicyFileError(f"{path} is neither a policy file, a run folder nor <module>:<function>")
    reasons: dict[str, str] = {}
    with contextlib.suppress(OSError, ValueError, AttributeError, TypeError):
        levels = parse_json((path / "selection.json").read_bytes()).get("levels", {})
        reasons = {name: found["reason"] for name, found in levels.items() if found.get("reason")}
    what = f"{level} policy" if level else "policies"
    if why := reasons.get(level) if level else next(iter(reasons.values()), None):
        return PolicyFileError(f"{path} has no {what} selected: {why}")
    one = f", or give one checkpoint: {quoted(f'{path}@latest')}" if (path / "checkpoints").is_dir() else ""
    return PolicyFileError(
        f"{path} has no {what} selected; run `dmcvb-gen select-checkpoints {quoted(path)}` first{one}"
    )
