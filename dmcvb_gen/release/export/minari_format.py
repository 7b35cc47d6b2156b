"""Minari's layout, written with minari itself: HDF5 storage, pictures without loss."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from dmcvb_gen.readers.register import NAMESPACE, environment_ids
from dmcvb_gen.release.export.episodes import ExportEpisode, Source


def write(source: Source, folder: Path) -> None:
    """Write a dataset that `minari.MinariDataset(folder / "data")` opens; copied to
    `~/.minari/datasets/dmcvb_gen/<task>/<level>-<setting>-v0/data`, it goes by that name."""
    subset = source.subset
    action = subset.array("action").shape[-1]
    pictures = {
        view: spaces.Box(0, 255, (subset.record.size, subset.record.size, 3), np.uint8) for view in source.views
    }
    state = spaces.Box(-np.inf, np.inf, (subset.array("state").shape[-1],), np.float32)
    storage = MinariStorage.new(
        folder / "data",
        observation_space=spaces.Dict({**pictures, "state": state}),
        action_space=spaces.Box(-1.0, 1.0, (action,), np.float32),
        env_spec=_environment(source),
        data_format="hdf5",
        jpeg_encoding=False,
    )
    storage.update_metadata(
        {
            "dataset_id": f"{NAMESPACE}/{subset.task}/{subset.level}-{subset.setting.replace('_', '-')}-v0",
            "minari_version": minari.__version__,
            "algorithm_name": subset.level,
            "author": set(source.manifest.authors),
            "code_permalink": source.manifest.generator,
            "description": source.description,
        }
    )
    storage.update_episodes(_buffer(number, episode) for number, episode in enumerate(source))


def _environment(source: Source):
    """The registered environment that shows what the data show; None where there is none."""
    record, name = source.subset.record, f"{NAMESPACE}/{source.subset.task}-{source.subset.setting.split('_')[0]}-v0"
    if name not in environment_ids():
        return None
    spec = gymnasium.spec(name)
    difficulty = source.subset.setting.partition("_")[2] or "medium"
    spec.kwargs = {
        **spec.kwargs,
        "difficulty": difficulty,
        "size": record.size,
        "renderer": record.renderer["name"],
        "samples": record.renderer.get("samples"),
    }
    return spec


def _buffer(number: int, episode: ExportEpisode) -> EpisodeBuffer:
    last = np.zeros(episode.length, bool)
    last[-1] = True
    return EpisodeBuffer(
        id=number,
        seed=episode.seed % 2**63,  # minari keeps signed numbers
        observations={**episode.pixels, "state": episode.state},
        actions=episode.action,
        rewards=episode.reward,
        terminations=last & episode.terminated,
        truncations=last & (not episode.terminated),
        infos={},
    )
