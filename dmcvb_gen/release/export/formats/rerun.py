"""Rerun recordings (rerun.io): one .rrd file an episode, lossless PNG images and curves over steps and seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dmcvb_gen.generate.modalities import modality_of
from dmcvb_gen.release.export.episodes import ExportEpisode, Source, png
from dmcvb_gen.release.export.registry import register_exporter


@register_exporter("rerun", modules=("rerun",))
def write(source: Source, folder: Path) -> None:
    """Write `episode_<index>.rrd` with the entities `image/<view>`, `state/<field>`, `action`, `reward` and `discount`.

    Modalities that are stored are images as well, "depth" or "depth/<view>": depth and segmentation of 16 bits, flow in
    colors. State, action and their fields' curves are named.

    Both timelines, `step` (a number) and `time` (simulated seconds), have a row for each observation; the last
    observation of an episode has no action, reward or discount.
    """
    import rerun

    for episode in source:
        name = f"{source.subset.name}/{episode.index:06d}"
        with rerun.RecordingStream("dmcvb-gen", recording_id=f"{source.manifest.name}/{name}") as recording:
            recording.save(folder / f"episode_{episode.index:06d}.rrd")
            recording.send_recording_name(name)
            facts = rerun.AnyValues(
                description=source.description, seed=str(episode.seed), terminated=episode.terminated
            )
            recording.send_property("episode", facts)
            _write_episode(recording, source, episode)
            recording.flush()


def _write_episode(recording, source: Source, episode: ExportEpisode) -> None:
    import rerun

    seconds = 1 / source.steps_per_second

    def send(entity: str, columns, rows: int) -> None:
        step = np.arange(rows)
        times = [rerun.TimeColumn("step", sequence=step), rerun.TimeColumn("time", duration=step * seconds)]
        recording.send_columns(entity, indexes=times, columns=columns)

    for view, frames in episode.pixels.items():
        send("image" if view == "pixels" else f"image/{view}", _colored(frames), len(frames))
    for name, values in episode.modalities.items():
        send(name, _modality(name, values), len(values))
    curves = {"action": (episode.action, source.names["action"])}
    curves |= {"reward": (episode.reward, ["reward"]), "discount": (episode.discount, ["discount"])}
    for field, (first, last) in source.fields.items():
        curves[f"state/{field}"] = (episode.state[:, first:last], source.names["state"][first:last])
    for entity, (values, names) in curves.items():
        recording.log(entity, rerun.SeriesLines(names=names), static=True)
        values = values.reshape(len(values), -1).astype(np.float64)
        send(entity, rerun.Scalars.columns(scalars=values), len(values))


def _colored(frames: np.ndarray):
    """Columns of images, (row, height, width, 3) uint8."""
    import rerun

    return rerun.EncodedImage.columns(blob=[png(frame) for frame in frames], media_type=["image/png"] * len(frames))


def _modality(name: str, values: np.ndarray):
    """Columns of a modality's images: depth in millimeters, numbers as classes, others in colors."""
    import rerun

    modality, rows = modality_of(name), len(values)
    if modality.levels is None:
        return _colored(modality.color(values))
    gray = modality.gray(values)
    if modality.name == "depth":
        blobs = [png(frame) for frame in gray]
        return rerun.EncodedDepthImage.columns(blob=blobs, media_type=["image/png"] * rows, meter=[1000.0] * rows)
    height, width = gray.shape[1:]
    form = rerun.components.ImageFormat(width, height, color_model="L", channel_datatype="U16")
    return rerun.SegmentationImage.columns(buffer=[frame.tobytes() for frame in gray], format=[form] * rows)
