"""Describe a release and the package as plain values."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.spec import DIFFICULTIES, FIXED, GOAL_MODES, LEVELS, distractor_kinds, is_maze
from dmcvb_gen.version import __version__

STATISTICS = ("mean", "std", "min", "p25", "median", "p75", "max")
"""Of episode returns, in the order of tables."""
PAPER_STEPS = {False: 1000, True: 1200}
"""Control steps at the time limit of the paper's data: locomotion, mazes."""


def return_statistics(returns: np.ndarray) -> dict[str, float]:
    """Mean, std, min, quartiles and max of episode returns (NaN without episodes)."""
    if not len(returns):
        return dict.fromkeys(STATISTICS, float("nan"))
    low, p25, median, p75, high = np.quantile(returns, (0, 0.25, 0.5, 0.75, 1))
    values = dict(mean=returns.mean(), std=returns.std(), min=low, p25=p25, median=median, p75=p75, max=high)
    return {name: float(value) for name, value in values.items()}


def describe_release(path: str | Path, storage_options: dict | None = None) -> dict[str, Any]:
    """Subsets of a release with episodes, steps, bytes and returns, the paper's row beside each.

    "normalized" is the mean return where the release's random actions have 0 and its expert 100; else None.
    "shipped" names the release that the package ships the manifest of, if its digest is the same.
    "missing" names the subsets of which nothing is here, and how many episodes they are to have.

    Raises:
      StoreError: there is no release at `path`.
    """
    from dmcvb_gen.dataset.gate import Release  # here, so that `list` is quick
    from dmcvb_gen.generate.references import normalized, reference_returns

    release = Release.open(path, storage_options)
    subsets = []
    for name, subset in release.subsets.items():
        references = reference_returns(release, subset.record, simulated=False)
        returns = return_statistics(subset.returns)
        subsets.append(
            dict(
                name=name,
                episodes=len(subset.episodes),
                episodes_planned=subset.record.episodes,
                complete=len(subset.episodes) == subset.record.episodes,
                steps=subset.steps,
                bytes=subset.bytes,
                size=subset.record.size,
                sizes=sorted({layer.arrays[0].shape[0] for layer in subset.layers if layer.kind == "images"}),
                images=any(layer.kind == "images" for layer in subset.layers),
                renderer=subset.record.renderer.get("name"),
                samples=subset.record.renderer.get("samples"),
                videos=subset.record.backgrounds and {k: subset.record.backgrounds[k] for k in ("source", "split")},
                policies=[policy.name for policy in subset.record.policies],
                returns=returns,
                normalized=normalized(returns["mean"], references),
                other_length=subset.record.max_steps * subset.record.action_repeat != PAPER_STEPS[is_maze(subset.task)],
                paper=None if subset.setting == FIXED else paper_returns(subset.task, subset.level),
            )
        )
    return dict(
        name=release.manifest.name,
        version=release.manifest.version,
        complete=not (release.in_the_making or release.unfinished),
        part=bool(release.copy and release.shortfalls),
        digest=release.digest,
        compared=release.compared,
        shipped=_shipped_twin(release.manifest.name, release.digest),
        steps=sum(subset["steps"] for subset in subsets),
        bytes=sum(file.bytes for shard in release.shards() if shard.here for file in shard.files),
        subsets=subsets,
        missing={name: planned for name, (_, planned) in release.unfinished.items() if name not in release.subsets},
    )


def _shipped_twin(name: str, digest: str | None) -> str | None:
    """Name and version of the shipped manifest of that name, if it has the digest."""
    from dmcvb_gen.generate.shipped import load_shipped, shipped_manifests

    if name in shipped_manifests() and (shipped := load_shipped(name)).digest == digest:
        return f"{name} {shipped.manifest.version}"
    return None


def describe_package() -> dict[str, Any]:
    """Tasks, levels, distractors, bundled behaviours, recipes, and renderers with why they cannot start here."""
    from dmcvb_gen.generate.recipe import shipped_recipes
    from dmcvb_gen.generate.shipped import shipped_manifests
    from dmcvb_gen.policies.bundled import bundled_levels
    from dmcvb_gen.rendering import available_renderers
    from dmcvb_gen.tasks import get_task, suite_ids, task_ids

    looking = ThreadPoolExecutor(1)
    renderers = looking.submit(available_renderers)  # OpenGL is tried in a process of its own
    tasks = [
        dict(
            id=task.id,
            state=task.state_size,
            action=task.action_size,
            max_steps=task.max_steps,
            views=list(task.views),
            behaviours=bundled_levels(task.id),
        )
        for task in map(get_task, task_ids())
    ]
    return dict(
        version=__version__,
        tasks=tasks,
        suite_tasks=list(suite_ids()),
        suite_behaviours={name: bundled_levels(name) for name in suite_ids() if bundled_levels(name)},
        levels=list(LEVELS),
        distractors=list(distractor_kinds()),
        difficulties=list(DIFFICULTIES),
        maze_settings=list(GOAL_MODES),
        recipes=list(shipped_recipes()),
        manifests=list(shipped_manifests()),
        renderers=renderers.result(),
    )
