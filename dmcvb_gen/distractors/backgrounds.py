"""Read square RGB frames of background videos from a folder or from the built-in clips.

Folders that are understood: DMC-VB's own (`train/` and `validation/`, each with videos), a DAVIS-like one
(a sub-folder of frames a video), loose videos and pictures. Without a split in the folder, every second
video in the order of names is for evaluation (the only video of a folder of one serves both). Names are
ordered as people count, `2.png` before `10.png`; hidden files are passed over.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
import subprocess
from collections import OrderedDict
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, ImageSequence

from dmcvb_gen.errors import BackgroundError, first_line

FRAME_SIZE = 256
"""Frames are cut to their central square and resized to this many pixels a side (Kubric MOVi-D's size)."""
MAX_FRAMES = 1000
"""A longer video counts with its first frames; a walk of 500 agent steps sees 101 of them."""
MAX_PIXELS = 2**26
"""Pixels of a frame before it is cut and resized, at most; more is a mistake or meant to fill the memory."""
DECODING_SECONDS = 600
"""Seconds that a video may take to decode."""
CACHE_BYTES = 256 * 2**20
"""Decoded frames that an open source keeps (and always the video asked for last)."""
PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
VIDEOS = {".mp4", ".m4v", ".avi", ".mov", ".mkv", ".mpg", ".mpeg", ".ts", ".wmv", ".flv", ".ogv", ".webm"}
VIDEOS |= {".gif", ".webp"}
_SPLITS = {"train": ("train", "training"), "val": ("val", "validation", "test")}


def builtin_folder() -> Path:
    """The clips that the package ships."""
    return Path(str(resources.files("dmcvb_gen.distractors"))) / "data" / "clips"


class Backgrounds:
    """The videos of one split of a source; frames are decoded when they are asked for.

    Making one decodes every video once, so that a bad file is found before any work; a pickled one opens at once.

    Attributes:
      names: names of the videos, in order.
      files: files of each video, in order: one, or a picture a frame.
      lengths: frames of each video.
      digest: SHA-256 over the decoded frames of all videos.

    Raises:
      BackgroundError: a file cannot be read.
    """

    def __init__(self, videos: list[tuple[str, tuple[Path, ...]]]):
        self.names = tuple(name for name, _ in videos)
        self.files = tuple(files for _, files in videos)
        self._decoded: OrderedDict[int, np.ndarray] = OrderedDict()
        lengths, digest = [], hashlib.sha256()
        for video in range(len(self)):
            frames = self.frames(video)
            lengths.append(len(frames))
            digest.update(frames.data)
        self.lengths, self.digest = tuple(lengths), digest.hexdigest()

    def __len__(self) -> int:
        return len(self.names)

    def __getstate__(self):
        return self.__dict__ | {"_decoded": OrderedDict()}

    def frames(self, video: int) -> np.ndarray:
        """(frame, 256, 256, 3) uint8, RGB, read-only.

        Raises:
          BackgroundError: a file cannot be read.
        """
        if video not in self._decoded:
            self._decoded[video] = _decode(self.files[video])
            held = sum(frames.nbytes for frames in self._decoded.values())
            while held > CACHE_BYTES and len(self._decoded) > 1:
                held -= self._decoded.popitem(last=False)[1].nbytes
        self._decoded.move_to_end(video)
        return self._decoded[video]


def load_backgrounds(source: str | Path = "builtin", split: str = "train") -> Backgrounds:
    """The background videos of a source. Opened again with its files unchanged, a source costs nothing.

    Args:
      source: "builtin" or a folder.
      split: "train" or "val".

    Raises:
      BackgroundError: no such folder, nothing in it, or a video that cannot be read or is cut short (named).
    """
    root = builtin_folder() if source == "builtin" else Path(source)
    if not root.is_dir():
        raise BackgroundError(f"backgrounds {str(source)!r} are no folder; give a folder of videos, or 'builtin'")
    try:
        found = _find_split(root, split)
        stamps = tuple((p.stat().st_mtime_ns, p.stat().st_size) for _, files in found for p in files)
    except OSError as error:
        raise BackgroundError(f"cannot read background folder {root} ({error.strerror or error})") from None
    if not found:
        kinds = " ".join(sorted(VIDEOS | PICTURES))
        raise BackgroundError(
            f"background folder {root} holds no videos; put in files of {kinds}, or a folder of images for each video"
        )
    return _open(str(source), split, tuple(found), stamps)


@functools.lru_cache(maxsize=2)
def _open(source: str, split: str, videos: tuple, stamps: tuple) -> Backgrounds:
    """Plans, workers and verification open the same source again and again; `stamps` notices changed files."""
    return Backgrounds(list(videos))


def _find_split(root: Path, split: str) -> list[tuple[str, tuple[Path, ...]]]:
    folders = _split_folders(root)
    for name in _SPLITS[split]:
        if name in folders:
            return _find_videos(root / name)
    if folders:
        raise BackgroundError(f"{root} has no {' or '.join(_SPLITS[split])} folder, only its other split")
    videos = _find_videos(root)
    if len(videos) == 1:
        return videos
    return videos[1::2] if split == "val" else videos[::2]


def _split_folders(root: Path) -> list[str]:
    """Folders of a split, like "train". One of images alone among other videos is a video: DAVIS has a "train"."""
    found = [name for names in _SPLITS.values() for name in names if (root / name).is_dir()]
    if len(found) != 1:
        return found
    kinds = {path.suffix.lower() for path in _listed(root / found[0])}
    one_of_many = any(name.partition("/")[0] != found[0] for name, _ in _find_videos(root))
    return [] if kinds and kinds <= PICTURES and one_of_many else found


def videos_by_split(source: str | Path) -> dict[str, int] | None:
    """Return how many videos each split takes; None if the folder is split already, or holds fewer than two."""
    root = Path(source)
    if not root.is_dir() or _split_folders(root):
        return None
    count = len(_find_videos(root))
    return {split: len(_find_split(root, split)) for split in _SPLITS} if count > 1 else None


def _listed(folder: Path) -> list[Path]:
    """List a folder without hidden files; numbers in names are ordered by value."""

    def key(path: Path):  # numbers at the odd places, words at the even ones
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)], path.name

    return sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=key)


def _find_videos(folder: Path) -> list[tuple[str, tuple[Path, ...]]]:
    """(name, files) of each video: a file, or a folder of pictures; a loose picture is a video of one frame."""
    videos = []
    for path in _listed(folder):
        if path.is_dir():
            frames = tuple(p for p in _listed(path) if p.suffix.lower() in PICTURES)
            inside = tuple(p for p in _listed(path) if p.suffix.lower() in VIDEOS)
            if frames:
                videos.append((path.name, frames[:MAX_FRAMES]))
            else:
                videos += [(f"{path.name}/{file.stem}", (file,)) for file in inside]
        elif path.suffix.lower() in VIDEOS | PICTURES:
            videos.append((path.stem, (path,)))
    return videos


def _decode(files: tuple[Path, ...]) -> np.ndarray:
    parts = []
    for path in files:  # one, or pictures of one frame each
        try:
            pictures = path.suffix.lower() in PICTURES | {".gif", ".webp"}
            parts.append(_read_pictures(path) if pictures else _read_video(path))
        except ModuleNotFoundError:  # the command says what to install
            raise
        except Exception as error:  # decoders raise many kinds; all mean the same to the user
            what = f"cannot read background {path} ({first_line(error)})"
            raise BackgroundError(f"{what}; remove or replace the file") from None
    frames = np.concatenate(parts) if len(parts) > 1 else parts[0]
    frames.flags.writeable = False  # the cache is shared
    return frames


def _read_pictures(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        if picture.width * picture.height > MAX_PIXELS:
            raise ValueError(f"{picture.width} x {picture.height} is more than {MAX_PIXELS:,} pixels")
        most = 1 if path.suffix.lower() in PICTURES else MAX_FRAMES  # some photos hold two; a hostile file has no end
        frames = itertools.islice(ImageSequence.Iterator(picture), most)
        upright = (ImageOps.exif_transpose(frame) for frame in frames)
        return np.stack([square(_eight_bits(frame).convert("RGB")) for frame in upright])


def _eight_bits(picture: Image.Image) -> Image.Image:
    """Scale images of 16 bits, which `convert` would cut at 255."""
    if not picture.mode.startswith("I"):
        return picture
    return picture.convert("I").point(lambda value: value / 257).convert("L")


def _read_video(path: Path) -> np.ndarray:
    """Decode with the ffmpeg that imageio-ffmpeg brings.

    Any complaint of the decoder counts as an error: a cut file otherwise just gives fewer frames. Scaling is
    the variant without processor-specific shortcuts, and only local files are opened, whatever a playlist says.
    """
    import imageio_ffmpeg

    middle = "crop='min(iw,ih)':'min(iw,ih)'"
    resize = f"scale={FRAME_SIZE}:{FRAME_SIZE}:flags=lanczos+accurate_rnd+full_chroma_int+bitexact"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", "-xerror"]
    command += ["-protocol_whitelist", "file,pipe", "-max_pixels", str(MAX_PIXELS)]
    command += ["-i", f"file:{path}", "-map", "0:v:0", "-frames:v", str(MAX_FRAMES), "-fps_mode", "passthrough"]
    command += ["-vf", f"{middle},{resize},format=rgb24", "-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"]
    try:
        run = subprocess.run(command, capture_output=True, check=False, timeout=DECODING_SECONDS)
    except subprocess.TimeoutExpired:
        raise ValueError(f"decoding it takes more than {DECODING_SECONDS} s") from None
    complaint = re.sub(r"\[[^]]*\]\s*", "", run.stderr[-2000:].decode(errors="replace")).strip()
    if complaint or run.returncode:
        raise ValueError(complaint or f"ffmpeg ended with code {run.returncode}")
    if not run.stdout:
        raise ValueError("no frames in it")
    return np.frombuffer(run.stdout, np.uint8).reshape(-1, FRAME_SIZE, FRAME_SIZE, 3)


def square(picture: Image.Image) -> np.ndarray:
    """The central square of a picture at FRAME_SIZE, (256, 256, 3) uint8."""
    side = min(picture.size)
    left, top = ((whole - side) // 2 for whole in picture.size)
    middle = picture.crop((left, top, left + side, top + side))
    return np.asarray(middle.resize((FRAME_SIZE, FRAME_SIZE), Image.Resampling.LANCZOS))
