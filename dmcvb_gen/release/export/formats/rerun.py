"""Rerun recordings (rerun.io): one .rrd file an episode, lossless PNG images and curves over steps and seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dmcvb_gen.generate.modalities import modality_of
from dmcvb_gen.release.export.episodes import ExportEpisode, Source, png
from dmcvb_gen.release.export.registry import register_exporter


@register_exporter(
    "rerun",
    reader="Rerun (`rerun exports/.../*.rrd`): a recording an episode",
    keeps="pixels, states, actions, rewards, discounts; depth, segmentation, flow as images",
    drops="physics, labels",
    mark="episode_*.rrd",
    modules=("rerun",),
)
def write(source: Source, folder: Path) -> None:
    """Write `episode_<index>.rrd` with the entities `image/<view>`, `state/<field>`, `action`, `reward` and `discount`.

    Depth, segmentation and flow that are stored are images as well, "depth" or "depth/<view>", by `Modality.color`.

    Both timelines, `step` (a number) and `time` (simulated seconds), have a row for each observation; the last
    observation of an episode has no action, reward or discount.
    """
    import rerun

    fields = _state_fields(source)
    for episode in source:
        name = f"{source.subset.name}/{episode.index:06d}"
        with rerun.RecordingStream("dmcvb-gen", recording_id=f"{source.manifest.name}/{name}") as recording:
            recording.save(folder / f"episode_{episode.index:06d}.rrd")
            recording.send_recording_name(name)
            facts = rerun.AnyValues(
                description=source.description, seed=str(episode.seed), terminated=episode.terminated
            )
            recording.send_property("episode", facts)
            _write_episode(recording, episode, fields, 1 / source.steps_per_second)
            recording.flush()


def _state_fields(source: Source) -> dict[str, slice]:
    """Name -> columns of the state."""
    from dmcvb_gen.tasks import get_task

    return dict(get_task(source.subset.task).state_slices)


def _write_episode(recording, episode: ExportEpisode, fields: dict[str, slice], seconds: float) -> None:
    import rerun

    def send(entity: str, columns, rows: int) -> None:
        step = np.arange(rows)
        times = [rerun.TimeColumn("step", sequence=step), rerun.TimeColumn("time", duration=step * seconds)]
        recording.send_columns(entity, indexes=times, columns=columns)

    shown = {"image" if view == "pixels" else f"image/{view}": frames for view, frames in episode.pixels.items()}
    for name, values in episode.modalities.items():
        shown[name] = modality_of(name).color(values)
    for entity, frames in shown.items():
        images = rerun.EncodedImage.columns(
            blob=[png(frame) for frame in frames], media_type=["image/png"] * len(frames)
        )
        send(entity, images, len(frames))
    curves = {f"state/{name}": episode.state[:, columns] for name, columns in fields.items()}
    curves |= {"action": episode.action, "reward": episode.reward, "discount": episode.discount}
    for entity, values in curves.items():
        values = values.reshape(len(values), -1).astype(np.float64)
        send(entity, rerun.Scalars.columns(scalars=values), len(values))
