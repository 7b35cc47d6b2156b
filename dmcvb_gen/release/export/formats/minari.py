"""Minari's layout, written with minari itself: HDF5 storage, pictures without loss, in the tree that minari looks for.

`MINARI_DATASETS_PATH=<out>` and `minari.load_dataset("dmcvb_gen/walker-walk/expert-dynamic-v0")` then open it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dmcvb_gen import files
from dmcvb_gen.loaders.register import ENTRY_POINT, NAMESPACE, environment_id
from dmcvb_gen.release.export.episodes import ExportEpisode, Source
from dmcvb_gen.release.export.registry import register_exporter
from dmcvb_gen.version import __version__

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from minari.data_collector import EpisodeBuffer


def folder_name(subset: str) -> str:
    """Return the id of a subset's data set, which is also its folder below the root of minari's data sets."""
    task, level, setting = subset.replace("_", "-").replace(".", "-").split("/")
    return f"{NAMESPACE}/{task}/{level}-{setting}-v0"


@register_exporter("minari", modules=("minari", "h5py"), folder_name=folder_name)
def write(source: Source, folder: Path) -> None:
    """Write `<folder>/data`, and what minari keeps of the namespaces above it.

    An observation is {"pixels": (size, size, 3 * view) uint8, "state"}, as the environment's.
    """
    import minari
    from gymnasium import spaces
    from minari.dataset.minari_storage import MinariStorage

    from dmcvb_gen.generate.references import reference_returns

    subset, size = source.subset, source.subset.record.size
    picture = spaces.Box(0, 255, (size, size, 3 * len(source.views)), np.uint8)
    state = spaces.Box(-np.inf, np.inf, (subset.array("state").shape[-1],), np.float32)
    shape, bounds = subset.array("action").shape[-1:], subset.spec("action").attributes
    low, high = (np.full(shape, bounds.get(name, one), np.float32) for name, one in (("low", -1), ("high", 1)))
    storage = MinariStorage.new(
        folder / "data",
        observation_space=spaces.Dict({"pixels": picture, "state": state}),
        action_space=spaces.Box(low, high, dtype=np.float32),
        env_spec=_environment(source, source.subset.record.split),
        data_format="hdf5",
        jpeg_encoding=False,
    )
    algorithms = sorted({str(policy.header.get("algorithm", subset.level)) for policy in subset.record.policies})
    facts = {
        "dataset_id": folder_name(subset.name),
        "minari_version": minari.__version__,
        "algorithm_name": ", ".join(algorithms) or subset.level,
        "author": set(source.manifest.authors),
        "code_permalink": f"dmcvb-gen {__version__}",
        "description": source.description + _about_videos(source),
        "requirements": [f"dmcvb-gen>={__version__}"],
        "state_names": source.names["state"],
        "action_names": source.names["action"],
        "joint_names": source.joints,
        "eval_env_spec": _environment(source, "val").to_json(),
    }
    if references := reference_returns(source.release, subset.record):
        facts |= {"ref_min_score": references[0], "ref_max_score": references[1]}
    storage.update_metadata(facts)
    storage.update_episodes(_buffer(number, episode) for number, episode in enumerate(source))
    storage.update_metadata({"dataset_size": storage.get_size()})
    about = {"description": f"{source.manifest.name} {source.manifest.version} (dmcvb-gen {__version__})"}
    # The namespaces are above the folder that is moved into its place when it is whole.
    files.write_json(folder.parents[2] / "namespace_metadata.json", about)
    files.write_json(folder.parents[1] / "namespace_metadata.json", {"description": subset.task})


def _environment(source: Source, split: str) -> EnvSpec:
    """The environment of the data, with videos and styles of a split: the data's own, or those kept for evaluation.

    Episodes are cut where the data's are, and so compare with the reference scores.
    """
    from gymnasium.envs.registration import EnvSpec

    from dmcvb_gen.loaders.matching import environment_options

    record = source.subset.record
    options = environment_options(source.subset, split)
    name = environment_id(record.name.split("/")[0], record.setting.partition("_")[0])
    return EnvSpec(name, entry_point=ENTRY_POINT, disable_env_checker=True, kwargs=options)


def _about_videos(source: Source) -> str:
    """A sentence about videos that the package does not bring, without their folder on this machine."""
    from dmcvb_gen.loaders.matching import own_videos

    videos = own_videos(source.subset)
    return f"; with its videos: recover_environment(backgrounds=FOLDER), the release's {videos}" if videos else ""


def _buffer(number: int, episode: ExportEpisode) -> EpisodeBuffer:
    from minari.data_collector import EpisodeBuffer

    last = np.zeros(episode.length, bool)
    last[-1] = True
    return EpisodeBuffer(
        id=number,
        seed=episode.seed % 2**63,  # minari keeps signed numbers
        observations={"pixels": episode.stacked(), "state": episode.state},
        actions=episode.action,
        rewards=episode.reward,
        terminations=last & episode.terminated,
        truncations=last & (not episode.terminated),
        infos={},
    )
