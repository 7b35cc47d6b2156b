"""Background videos: a folder (or the built-in clips) in, square RGB frames out.

Folders that are understood: DMC-VB's own (`train/` and `validation/`, each with videos), a DAVIS-like one
(a sub-folder of frames a video), loose videos and pictures. Without a split in the folder, every second
video in the order of names is for evaluation (the only video of a folder of one serves both).
"""

from __future__ import annotations

import functools
import hashlib
from collections import OrderedDict
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image

from dmcvb_gen.errors import BackgroundError

FRAME_SIZE = 256
"""Frames are cut to their central square and resized to this many pixels a side (Kubric MOVi-D's size)."""
PICTURES = {".png", ".jpg", ".jpeg", ".bmp"}
VIDEOS = {".mp4", ".avi", ".mov", ".mkv", ".webm", ".gif", ".webp"}
_SPLITS = {"train": ("train", "training"), "val": ("val", "validation", "test")}
_CACHED = 16  # decoded videos kept, 5 MB each at 24 frames


def builtin_folder() -> Path:
    """The clips that the package ships."""
    return Path(str(resources.files("dmcvb_gen.distractors"))) / "data" / "clips"


class Backgrounds:
    """The videos of one split of a source; frames are decoded when they are asked for.

    Attributes:
      source: "builtin" or the folder.
      split: "train" or "val".
      names: of the videos, sorted.
    """

    def __init__(self, source: str, split: str, videos: list[tuple[str, tuple[Path, ...]]]):
        self.source, self.split = source, split
        self.names = tuple(name for name, _ in videos)
        self._files = tuple(files for _, files in videos)
        self._decoded: OrderedDict[int, np.ndarray] = OrderedDict()

    def __len__(self) -> int:
        return len(self.names)

    def __getstate__(self):
        return self.__dict__ | {"_decoded": OrderedDict()}

    def frames(self, video: int) -> np.ndarray:
        """(frame, 256, 256, 3) uint8, RGB.

        Raises:
          BackgroundError: a file cannot be read.
        """
        if video not in self._decoded:
            while len(self._decoded) >= _CACHED:
                self._decoded.popitem(last=False)
            self._decoded[video] = _decode(self._files[video])
        self._decoded.move_to_end(video)
        return self._decoded[video]

    @functools.cached_property
    def lengths(self) -> tuple[int, ...]:
        """Frames of each video."""
        return tuple(len(self.frames(video)) for video in range(len(self)))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 over the decoded frames of all videos."""
        digest = hashlib.sha256()
        for video in range(len(self)):
            digest.update(self.frames(video).tobytes())
        return digest.hexdigest()


def load_backgrounds(source: str | Path = "builtin", split: str = "train") -> Backgrounds:
    """The background videos of a source.

    Args:
      source: "builtin" or a folder.
      split: "train" or "val".

    Raises:
      BackgroundError: no such folder, nothing in it, or a video that cannot be read (named).
    """
    if split not in _SPLITS:
        raise BackgroundError(f"unknown split {split!r} of backgrounds; known: train, val")
    root = builtin_folder() if source == "builtin" else Path(source)
    if not root.is_dir():
        raise BackgroundError(f"background folder {str(source)!r} does not exist; give a folder of videos or 'builtin'")
    for name in _SPLITS[split]:
        if (root / name).is_dir():
            videos = _find_videos(root / name)
            break
    else:
        if any((root / name).is_dir() for names in _SPLITS.values() for name in names):
            raise BackgroundError(f"{root} has no {' or '.join(_SPLITS[split])} folder beside its other split")
        videos = _find_videos(root)
        if len(videos) > 1:
            videos = videos[1::2] if split == "val" else videos[::2]
    if not videos:
        kinds = " ".join(sorted(VIDEOS | PICTURES))
        raise BackgroundError(f"background folder {root} holds no videos; put in files of {kinds}")
    backgrounds = Backgrounds(str(source), split, videos)
    backgrounds.lengths  # every video is opened once, so that a bad one is found before any work  # noqa: B018
    return backgrounds


def _find_videos(folder: Path) -> list[tuple[str, tuple[Path, ...]]]:
    """(name, files) of each video: a file, or a folder of pictures; a loose picture is a video of one frame."""
    videos = []
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            frames = tuple(sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURES))
            inside = tuple(sorted(p for p in path.iterdir() if p.suffix.lower() in VIDEOS))
            if frames:
                videos.append((path.name, frames))
            else:
                videos += [(f"{path.name}/{file.stem}", (file,)) for file in inside]
        elif path.suffix.lower() in VIDEOS | PICTURES:
            videos.append((path.stem, (path,)))
    return videos


def _decode(files: tuple[Path, ...]) -> np.ndarray:
    frames = []
    for path in files:
        try:
            frames += _read(path)
        except Exception as error:  # decoders raise many kinds; all mean the same to the user
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise BackgroundError(f"cannot read background {path} ({reason}); remove or replace the file") from None
    if not frames:
        raise BackgroundError(f"background {files[0]} has no frames; remove or replace the file")
    return np.stack(frames)


def _read(path: Path) -> list[np.ndarray]:
    if path.suffix.lower() in PICTURES | {".gif", ".webp"}:
        with Image.open(path) as picture:
            frames = []
            for index in range(getattr(picture, "n_frames", 1)):
                picture.seek(index)
                frames.append(square(picture.convert("RGB")))
            return frames
    import imageio.v3 as iio

    return [square(Image.fromarray(frame[..., :3])) for frame in iio.imiter(path, plugin="FFMPEG")]


def square(picture: Image.Image) -> np.ndarray:
    """The central square of a picture at FRAME_SIZE, (256, 256, 3) uint8."""
    width, height = picture.size
    side = min(width, height)
    left, top = (width - side) // 2, (height - side) // 2
    if (width, height) == (FRAME_SIZE, FRAME_SIZE):
        return np.asarray(picture)
    middle = picture.crop((left, top, left + side, top + side))
    return np.asarray(middle.resize((FRAME_SIZE, FRAME_SIZE), Image.Resampling.LANCZOS))
