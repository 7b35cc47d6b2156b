"""Write a contact sheet (PNG) and a video (WebP) of a release's episodes."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.errors import StoreError
from dmcvb_gen.options import Count, Local, Location, Names, checked
from dmcvb_gen.spec import select
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.storage.store import open_store
from dmcvb_gen.text import as_names, quoted

SHEET_COLUMNS, SHEET_EPISODES = 10, 8
"""Frames of an episode on the contact sheet, evenly spaced, and about its episodes: it is readable on one screen."""
VIDEO_FRAMES, VIDEO_FPS = 200, 20
VIDEO_SIDE = 512
"""Pixels that a side of a video has at least, about."""
LABEL_HEIGHT, LABEL_SIZE = 20, 15


def _enlarge(frames: np.ndarray, scale: int) -> np.ndarray:
    """(..., height, width, 3) nearest-neighbor enlargement."""
    return frames.repeat(scale, axis=-3).repeat(scale, axis=-2)


def _label(text: str, width: int) -> np.ndarray:
    """(LABEL_HEIGHT, width, 3): a caption."""
    picture = Image.new("RGB", (width, LABEL_HEIGHT), (255, 255, 255))
    ImageDraw.Draw(picture).text((2, 0), text, fill=(0, 0, 0), font=ImageFont.load_default(LABEL_SIZE))
    return np.asarray(picture)


def _fitting(name: str, width: int) -> str:
    """Return the last parts of a subset's name that fit into a caption of that width in pixels."""
    parts, font = name.split("/"), ImageFont.load_default(LABEL_SIZE)
    endings = ["/".join(parts[first:]) for first in range(len(parts))]
    return next((ending for ending in endings if font.getlength(ending) <= width), parts[-1])


def episode_strip(subset: Subset, episode: int, columns: int = SHEET_COLUMNS, scale: int = 2) -> np.ndarray:
    """Evenly spaced frames of one episode side by side under a caption, a row a view; (h, w, 3) uint8.

    If there are several views, each row has its name above it.
    """
    length = int(subset.read("length", [episode])[0])
    steps = np.linspace(0, length, columns).round().astype(int)
    pictures, rows = shown(subset), []
    for view, name in zip(pictures.views, pictures.arrays, strict=True):
        frames = subset.episode(episode, [name, "length"])[name][steps]
        rows.append((view, np.concatenate(list(_enlarge(frames, scale)), axis=1)))
    named = [part for view, row in rows for part in (_label(view, row.shape[1]), row)]
    picture = np.concatenate(named if len(rows) > 1 else [rows[0][1]])
    value = float(subset.read("return", [episode])[0])
    caption = f"{subset.name}  episode {episode}  {length} steps  return {value:.1f}"
    return np.concatenate([_label(caption, picture.shape[1]), picture])


def contact_sheet(subsets: Sequence[Subset], episodes: int = 4, scale: int = 2) -> np.ndarray:
    """Strips of the first episodes of each subset under each other; (height, width, 3) uint8."""
    strips = [
        episode_strip(subset, int(episode), scale=scale) for subset in subsets for episode in subset.episodes[:episodes]
    ]
    width = max(strip.shape[1] for strip in strips)
    strips = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    return np.concatenate(strips)


def video_frames(
    subsets: Sequence[Subset], scale: int | None = None, frames: int = VIDEO_FRAMES, episode: int | None = None
) -> np.ndarray:
    """An episode of every subset side by side, the first by default; (frame, height, width, 3) uint8.

    Args:
      scale: enlargement of the images; by default what gives a side some `VIDEO_SIDE` pixels.
    """
    if scale is None:
        rows = np.ceil(np.sqrt(sum(len(shown(subset).views) for subset in subsets)))
        scale = max(1, int(np.ceil(VIDEO_SIDE / (rows * subsets[0].record.size))))
    return _grid([_subset_frames(subset, scale, frames, episode) for subset in subsets])


def _subset_frames(subset: Subset, scale: int, frames: int, episode: int | None) -> np.ndarray:
    """(frame, height, width, 3): the views of one episode in a grid, under its name, step and return so far."""
    pictures = shown(subset)
    episode = int(subset.episodes[0]) if episode is None else episode
    values = subset.episode(episode, [*pictures.arrays, "reward"])
    returns = np.concatenate([[0.0], values["reward"].cumsum()])
    steps = np.minimum(np.arange(frames), len(values[pictures.arrays[0]]) - 1)
    views = [_enlarge(values[name][steps], scale) for name in pictures.arrays]
    picture = _grid(views)
    width = picture.shape[2]
    lines = ((_fitting(subset.name, width), f"episode {episode}  step {i}", f"return {returns[i]:.1f}") for i in steps)
    labels = [np.concatenate([_label(text, width) for text in texts]) for texts in lines]
    return np.concatenate([np.stack(labels), picture], axis=1)


def _grid(videos: Sequence[np.ndarray]) -> np.ndarray:
    """Videos (frame, height, width, 3) in rows, somewhat wider than high; gaps are white."""
    columns = min(len(videos), int(np.ceil(np.sqrt(len(videos) * 1.5))))
    height, width = (max(video.shape[axis] for video in videos) for axis in (1, 2))
    whole = [
        np.pad(v, ((0, 0), (0, height - v.shape[1]), (0, width - v.shape[2]), (0, 0)), constant_values=255)
        for v in videos
    ]
    whole += [np.full_like(whole[0], 255)] * (-len(whole) % columns)
    rows = [np.concatenate(whole[i : i + columns], axis=2) for i in range(0, len(whole), columns)]
    return np.concatenate(rows, axis=1)


@checked
def write_preview(
    release: Location, *, only: Names = (), out: Local | None = None, episodes: Count | None = None
) -> list[Path]:
    """Write contact_sheet.png and preview.webp of a release.

    Args:
      release (RELEASE): Folder of the release.
      only (PATTERN): Show only these subsets.
      out (FOLDER): Output folder. [default: RELEASE/preview]
      episodes: Episodes per subset on the sheet; the video shows the first of each. [default: 8 in all, at most 4]

    Returns:
      The files.

    Raises:
      StoreError: the release has no episodes with images yet, or the folder cannot be written.
    """
    opened = Release.open(release)
    names = select(list(opened.subsets), as_names(only)) if opened.subsets else []
    subsets = [opened.subsets[name] for name in names if opened.subsets[name].pixel_arrays]
    if not subsets:
        cure = f"see which episodes exist: dmcvb-gen verify {quoted(release)}"
        if names:
            cure = f"add them: dmcvb-gen paint {quoted(release)}, or see it without: dmcvb-gen view {quoted(release)}"
        raise StoreError(f"{release} has no finished episodes with images; {cure}")
    folder = local_path(out) if out else opened.path / "preview"
    few = episodes or max(1, min(4, SHEET_EPISODES // len(subsets)))
    store, sheet = open_store(folder), io.BytesIO()  # a store writes through no link
    Image.fromarray(contact_sheet(subsets, few)).save(sheet, "PNG")
    store.replace("contact_sheet.png", sheet.getvalue())
    store.replace("preview.webp", video_bytes(video_frames(subsets)))
    return [folder / "contact_sheet.png", folder / "preview.webp"]


def video_bytes(frames: np.ndarray) -> bytes:
    """(frame, height, width, 3) uint8 as a WebP."""
    video = io.BytesIO()
    first, *rest = map(Image.fromarray, frames)
    options = {"duration": 1000 // VIDEO_FPS, "loop": 0, "quality": 60, "method": 5}
    first.save(video, "WEBP", save_all=True, append_images=rest, **options)
    return video.getvalue()
