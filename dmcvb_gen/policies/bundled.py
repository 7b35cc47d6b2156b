"""Find the policy files of a level: the package's own by default, or those of a file or run."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

from dmcvb_gen.errors import DmcvbError, PolicyFileError
from dmcvb_gen.files import parse_json
from dmcvb_gen.own_code import is_own
from dmcvb_gen.policies.archives import bundled_digests, bundled_file
from dmcvb_gen.spec import TRAINED_LEVELS, MazeName, task_folder
from dmcvb_gen.text import quoted

CONVERTED = (".zip", ".pt", ".pth", ".cleanrl_model")
"""Files of other programs' policies, which are converted: Stable-Baselines3's, torch's and CleanRL's."""
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
    names = bundled_names(task_id, level)
    if not names:
        have = ", ".join([*bundled_levels(task_id), "random"])
        maze = MazeName.parse(task_id)
        own = maze is not None and maze.rows is not None
        asked = "--layout FILE" if own else task_id + (" --algo guided" if maze else "")
        raise DmcvbError(
            f"no {level} policy of {task_folder(task_id)} is bundled (there is: {have}); "
            f"train one with `dmcvb-gen train-behaviour {asked}` and "
            "`dmcvb-gen select-checkpoints`, then give its run folder with --behaviour"
        )
    return [bundled_file(name) for name in names]


def levels_of(behaviour: str | Path) -> list[str]:
    """Levels that a run folder or a folder of level files has policies for; a single policy file's own level.

    Raises:
      PolicyFileError: there are none, or no such file or folder.
    """
    path = Path(behaviour)
    if not path.exists():
        raise _neither(behaviour)
    if path.is_file():
        from dmcvb_gen.policies.policy_file import read_header  # loads numba, which listing needs not

        return [read_header(path).level or path.stem]
    for folder in (path / "selected", path):
        levels = [level for level in TRAINED_LEVELS if level_files(folder, level)]
        if levels:
            return levels
    reasons = _reasons(path)
    if reasons:
        raise PolicyFileError(f"{behaviour} has no selected policies: {next(iter(reasons.values()))}")
    raise PolicyFileError(
        f"{behaviour} has no selected policies; run `dmcvb-gen select-checkpoints {quoted(behaviour)}` first, "
        "or give a policy file"
    )


def _neither(behaviour: str | Path) -> PolicyFileError:
    return PolicyFileError(f"{behaviour} is neither a policy file, a run folder nor <module>:<function>")


def _reasons(run: Path) -> dict[str, str]:
    """Level -> why the last selection picked none of it; empty if there was none, or its file is damaged."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        levels = parse_json((run / "selection.json").read_bytes()).get("levels", {})
        return {level: found["reason"] for level, found in levels.items() if found.get("reason")}
    return {}


def resolve_policies(task_id: str, level: str, behaviour: str | Path | None = None) -> list[Path]:
    """Policy files of a level: bundled ones, or those of `behaviour`.

    Args:
      behaviour: a policy file, another program's (`policies.convert`), a run folder in which checkpoints were selected,
        a folder of level files, or "<module>:<function>".

    Raises:
      DmcvbError: there is nothing for that level.
    """
    if behaviour is None:
        return bundled_policies(task_id, level)
    path = Path(behaviour)
    if path.suffix in CONVERTED and path.is_file():
        from dmcvb_gen.policies.convert import converted

        return [converted(path, task_id, level)]
    if path.is_file() or is_own(str(behaviour)):
        return [path]
    if not path.is_dir():
        raise _neither(behaviour)
    for folder in (path / "selected", path):
        files = level_files(folder, level)
        if files:
            return files
    if why := _reasons(path).get(level):
        raise PolicyFileError(f"{behaviour} has no {level} policy selected: {why}")
    if level == "mixed" and (strange := sorted(path.glob("mixed_*.safetensors"))):
        raise PolicyFileError(
            f"{behaviour} has no numbered mixed policy, only {strange[0].name}; name its files mixed_0.safetensors, "
            "mixed_1.safetensors, ..."
        )
    raise PolicyFileError(
        f"{behaviour} has no {level} policy selected; run `dmcvb-gen select-checkpoints {quoted(behaviour)}` first"
    )
