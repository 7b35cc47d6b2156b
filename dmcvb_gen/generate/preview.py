"""Write a contact sheet (PNG) and a video of a release's episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.extras import installed
from dmcvb_gen.spec import select
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.text import quoted

SHEET_COLUMNS = 10
"""Frames of an episode on the contact sheet, evenly spaced."""
VIDEO_FRAMES, VIDEO_FPS = 200, 20
SHEET_SCALE, VIDEO_SIDE = 2, 512
"""Enlargement on the contact sheet; pixels that the shorter side of a video has at least."""
FORMATS = ("mp4", "webp", "gif")
LABEL_HEIGHT = 14


def _enlarge(frames: np.ndarray, scale: int) -> np.ndarray:
    """(..., height, width, 3) nearest-neighbor enlargement."""
    return frames.repeat(scale, axis=-3).repeat(scale, axis=-2)


def _label(text: str, width: int) -> np.ndarray:
    """(LABEL_HEIGHT, width, 3): a caption."""
    picture = Image.new("RGB", (width, LABEL_HEIGHT), (255, 255, 255))
    ImageDraw.Draw(picture).text((2, 1), text, fill=(0, 0, 0))
    return np.asarray(picture)


def _fitting(name: str, width: int) -> str:
    """Return the last parts of a subset's name that fit into a caption of that width in pixels."""
    parts = name.split("/")
    endings = ["/".join(parts[first:]) for first in range(len(parts))]
    return next((text for text in endings if ImageFont.load_default().getlength(text) <= width), parts[-1])


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


def contact_sheet(
    subsets: Sequence[Subset], episodes: int = 4, columns: int = SHEET_COLUMNS, scale: int = 2
) -> np.ndarray:
    """Strips of the first episodes of each subset under each other; (height, width, 3) uint8."""
    strips = [
        episode_strip(subset, int(episode), columns, scale)
        for subset in subsets
        for episode in subset.episodes[:episodes]
    ]
    width = max(strip.shape[1] for strip in strips)
    strips = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    return np.concatenate(strips)


def video_frames(
    subsets: Sequence[Subset], scale: int | None = None, frames: int = VIDEO_FRAMES, episode: int | None = None
) -> np.ndarray:
    """An episode of every subset side by side, the first by default; (frame, height, width, 3) uint8.

    Args:
      scale: enlargement of the images; by default the smallest with `VIDEO_SIDE` pixels on the shorter side.
    """
    if scale is None:  # labels do not grow with the images, so two sizes say how the sides grow
        one, two = (np.array(_grid([_subset_frames(s, n, 1, episode) for s in subsets]).shape[1:3]) for n in (1, 2))
        scale = max(1, int(np.ceil((VIDEO_SIDE - (2 * one - two)) / (two - one)).max()))
    return _grid([_subset_frames(subset, scale, frames, episode) for subset in subsets])


def _subset_frames(subset: Subset, scale: int, frames: int, episode: int | None) -> np.ndarray:
    """(frame, height, width, 3): the views of one episode in a grid, under the subset's name."""
    pictures = shown(subset)
    values = subset.episode(int(subset.episodes[0]) if episode is None else episode, pictures.arrays)
    steps = np.minimum(np.arange(frames), len(values[pictures.arrays[0]]) - 1)
    views = [_enlarge(values[name][steps], scale) for name in pictures.arrays]
    picture = _grid(views)
    label = _label(_fitting(subset.name, picture.shape[2]), picture.shape[2])
    return np.concatenate([np.broadcast_to(label, (frames, *label.shape)), picture], axis=1)


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


def write_preview(
    path: str | Path,
    out: str | Path | None = None,
    *,
    only: Sequence[str] = (),
    episodes: int = 4,
    scale: int | None = None,
    frames: int = VIDEO_FRAMES,
    episode: int | None = None,
    video: str | None = None,
) -> list[Path]:
    """Write contact_sheet.png and preview.mp4 (or .webp, .gif) of a release.

    Args:
      out: folder of the files; `<release>/preview` by default.
      only: subset patterns.
      episodes: number of episodes of each subset on the sheet.
      scale: enlargement of the images; by default 2 on the sheet, and in the video what makes it 512 pixels or more.
      frames: number of frames of the video, which has 20 a second.
      episode: which episode of each subset the video shows; the first by default.
      video: "mp4", "webp" or "gif"; by default mp4 if imageio-ffmpeg is installed, else webp.

    Returns:
      The files.

    Raises:
      StoreError: the release has no episodes yet, or the folder cannot be written.
      UnknownNameError: no such kind of video.
    """
    kind = video or ("mp4" if installed("imageio_ffmpeg") else "webp")
    if kind not in FORMATS:
        raise UnknownNameError("kind of video", kind, FORMATS)
    target = local_path(out) if out else None
    release = Release.open(path)
    names = select(list(release.subsets), list(only)) if release.subsets else []
    subsets = [release.subsets[name] for name in names if release.subsets[name].pixel_arrays]
    if not subsets:
        cure = f"see which episodes exist: dmcvb-gen verify {quoted(path)}"
        if names:
            cure = f"add them: dmcvb-gen paint {quoted(path)}, or see it without: dmcvb-gen view {quoted(path)}"
        raise StoreError(f"{path} has no finished episodes with images; {cure}")
    folder = target or release.path / "preview"
    picture = Image.fromarray(contact_sheet(subsets, episodes, scale=scale or SHEET_SCALE))
    with storage_errors(folder, "write to"):
        folder.mkdir(parents=True, exist_ok=True)
        sheet = folder / "contact_sheet.png"
        picture.save(sheet)
        moving = folder / f"preview.{kind}"
        (_write_mp4 if kind == "mp4" else _write_animation)(moving, video_frames(subsets, scale, frames, episode))
    return [sheet, moving]


def _write_animation(path: Path, frames: np.ndarray) -> None:
    """(frame, height, width, 3) uint8 as a WebP or GIF."""
    first, *rest = [Image.fromarray(frame) for frame in frames]
    options: dict[str, Any] = {"quality": 60, "method": 5} if path.suffix == ".webp" else {}
    first.save(path, save_all=True, append_images=rest, duration=1000 // VIDEO_FPS, loop=0, **options)


def _write_mp4(path: Path, frames: np.ndarray) -> None:
    import imageio_ffmpeg

    even = np.pad(frames, ((0, 0), (0, frames.shape[1] % 2), (0, frames.shape[2] % 2), (0, 0)))
    size = even.shape[2], even.shape[1]
    encoder = imageio_ffmpeg.write_frames(str(path), size, fps=VIDEO_FPS, quality=8, macro_block_size=2)
    encoder.send(None)
    for frame in even:
        encoder.send(np.ascontiguousarray(frame))
    encoder.close()
