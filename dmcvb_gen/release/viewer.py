"""The viewer: one HTML file that plays the episodes of a release in any browser, without a network.

The file holds everything: pictures as WebP sheets, curves as 16-bit integers, and the script that shows them. Pictures
that the release does not store are painted while the file is written.
"""

import base64
import io
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.distractor_state import LABEL_DTYPES
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes, write_bytes
from dmcvb_gen.loaders.painted import Painting, painted_release
from dmcvb_gen.loaders.release import ReleaseReader, SubsetReader
from dmcvb_gen.options import Count, Local, Location, Names, checked, progress_bar
from dmcvb_gen.release.export.episodes import entry_names
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import is_url, local_path
from dmcvb_gen.storage.places import shown as shown_place
from dmcvb_gen.storage.store import open_store
from dmcvb_gen.text import as_names, quoted

VIEWER = "preview/viewer.html"
"""Default place in the release."""
EPISODES = 12
"""Episodes in a file by default, shared out among the subsets."""
SHEET_SIDE = 4096
"""Largest width and height of a sheet of pictures, in pixels."""
WEBP_QUALITY = 85
LEVELS = 65535
"""Steps of a number's range that the file distinguishes."""
CAMERA_AXES = {"camera_position": "xyz", "camera_quaternion": "wxyz", "material_rgb": "rgb", "light_shift": "xyz"}


@dataclass(frozen=True)
class Written:
    """A viewer file.

    Attributes:
      path, bytes: the file and its size.
      episodes: number of episodes that it shows. subsets: number of their subsets.
      stride: every how many-th picture it has; 1 if all are there.
    """

    path: Path
    bytes: int
    episodes: int
    subsets: int
    stride: int


@checked
def view(
    path: Location,
    out: Local | None = None,
    *,
    only: Names = (),
    episodes: Count | None = None,
    size: Annotated[int, Ge(8), Le(1024)] | None = None,
    max_mb: Annotated[float, Gt(0), Lt(math.inf)] = 20.0,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> Written:
    """Write one HTML file that plays episodes of a release: images, rewards, actions, states and labels.

    Args:
      path (RELEASE|URL): Folder or URL of the release.
      out (FILE): The file. [default: RELEASE/preview/viewer.html]
      only (PATTERN): Show only these subsets.
      episodes: Episodes of each subset. [default: 12 in all]
      size: Render the images at this size instead of the stored one.
      max_mb: Largest file; images are left out evenly until it is small enough.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.

    Raises:
      StoreError: the release has no episodes yet, its images cannot be rendered, or the file cannot be written.
      UnknownNameError: no such subset.
    """
    path = str(path)
    if not out and is_url(path):
        raise StoreError(f"{shown_place(path)} is a URL: say with --out where to write the file")
    target = local_path(out) if out else None
    release = ReleaseReader.open(path, storage_options)
    names = [name for name in release.select(as_names(only)) if name in release]
    if not names:
        raise StoreError(f"{shown_place(path)} has no finished episodes; run the rollout first")
    imported = [name for name in names if release[name].record.imported]
    if size and imported:
        raise StoreError(f"{imported[0]} was imported and has no physics states to paint from; remove --size")
    if size or any(subset.unpainted.any() for subset in release.subsets.values()):
        release = painted_release(release, Painting(size=size), missing=not size)
    each = episodes or max(1, EPISODES // len(names))
    chosen = [(release[name], int(index)) for name in names for index in release[name].episodes[:each]]
    parts = []
    with progress_bar(progress, " episodes", scaled=False) as bar:
        bar.expect(len(chosen))
        for subset, index in chosen:
            parts.append(_episode(subset, index, _command(release, path, subset, index)))
            bar(1)
    page, stride = _fitted(release, parts, int(max_mb * 1e6))
    if target is None:
        target = release.path / VIEWER
        open_store(release.path).replace(VIEWER, page)  # which writes through no link
    else:
        with storage_errors(target, "write to"):
            write_bytes(target, page)
    return Written(target, len(page), len(parts), len(names), stride)


def _fitted(release: Release, parts: list[dict[str, Any]], max_bytes: int) -> tuple[bytes, int]:
    """The page with as many pictures as fit, and every how many-th picture that is."""
    stride, longest = 1, max(part["length"] for part in parts)
    while len(page := _page(release, [_with_sheets(part, stride) for part in parts])) > max_bytes:
        if stride > longest:
            raise StoreError(
                f"{len(parts)} episodes do not fit into {max_bytes / 1e6:.1f} MB; take fewer with --only or --episodes"
            )
        stride = max(stride + 1, math.ceil(stride * len(page) / max_bytes))
    return page, stride


def _page(release: Release, parts: list[dict[str, Any]]) -> bytes:
    from jinja2 import Environment, PackageLoader

    manifest = release.manifest
    facts = dict(name=manifest.name, version=manifest.version, digest=release.digest or "", episodes=parts)
    # In a script, "<" could end it, so the data have none.
    data = json.dumps(facts, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    templates = Environment(loader=PackageLoader("dmcvb_gen.release", "data"), autoescape=True)
    return templates.get_template("viewer.html").render(title=manifest.name, data=data).encode()


def _command(release: Release, path: str, subset: SubsetReader, index: int) -> str:
    """The command that makes an episode's shard again, or fetches it from a URL; "" if nothing can make it."""
    what = f"--only {quoted(subset.name)} --range {index}:{index + 1} --out regenerated"
    if is_url(path):
        return f"dmcvb-gen fetch {quoted(shown_place(path))} {what}"
    if subset.record.imported:
        return ""
    return f"dmcvb-gen regenerate {quoted(Path(path).resolve())} {what}"


# -- one episode ----------------------------------------------------------------------------------


def _episode(subset: SubsetReader, index: int, command: str) -> dict[str, Any]:
    """Collect what the page shows of an episode: facts, views with their raw frames, and groups of curves."""
    pictures, layer, names = shown(subset), subset.trajectories, entry_names(subset)
    span = layer.episodes_of(index // layer.episodes_per_shard)
    shows = subset.setting != "none"
    labels = [name for name in LABEL_DTYPES if shows and f"exogenous/{name}" in subset.arrays]
    numbers = ["state", "action", "reward", "seed", "terminated"]
    values = subset.episode(index, [*numbers, *(f"exogenous/{name}" for name in labels), *pictures.arrays])
    earned = np.concatenate([[0], np.cumsum(values["reward"], dtype=float)])
    return {
        "subset": subset.name,
        "index": index,
        "length": len(values["reward"]),
        "return": float(values["reward"].astype(np.float64).sum()),
        "seed": str(int(values["seed"])),
        "terminated": bool(values["terminated"]),
        "seconds": subset.record.seconds_per_step,
        "trajectory": sha256_bytes(values["state"].tobytes() + values["action"].tobytes())[:16],
        "command": command,
        "shard": [span.start, min(span.stop, subset.record.episodes)],
        "frames": {view: values[name] for view, name in zip(pictures.views, pictures.arrays, strict=True)},
        "curves": {
            "reward": [_curve("reward", values["reward"]), _curve("return so far", earned)],
            "action": [_curve(name, column) for name, column in zip(names["action"], values["action"].T, strict=True)],
            "state": [_curve(name, column) for name, column in zip(names["state"], values["state"].T, strict=True)],
            "distractor": [
                _curve(name, column)
                for label in labels
                for name, column in _label_columns(label, values[f"exogenous/{label}"], pictures.views)
            ],
        },
    }


def _label_columns(label: str, values: np.ndarray, views: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Named columns of a label: "camera_position top x", "material_rgb 3 g", "style"."""
    if values.ndim == 1:
        yield label, values
        return
    if values.ndim == 2:
        values = values[:, None]
    for row in range(values.shape[1]):
        name = (views[row] if row < len(views) else str(row)) if label.startswith("camera") else str(row)
        name = "" if values.shape[1] == 1 else f"{name} "
        for axis, letter in enumerate(CAMERA_AXES[label]):
            yield f"{label} {name}{letter}", values[:, row, axis]


def _curve(name: str, values: np.ndarray) -> dict[str, Any]:
    """A curve as its range and 16-bit places in it; numbers that are not finite are taken for zero."""
    values = np.nan_to_num(values.astype(np.float64), posinf=0.0, neginf=0.0)
    low, high = float(values.min()), float(values.max())
    curve: dict[str, Any] = {"name": name, "low": low, "high": high}
    if high > low:
        places = np.round((values - low) / (high - low) * LEVELS).astype("<u2")
        curve["places"] = base64.b64encode(places.tobytes()).decode()
    return curve


def _with_sheets(part: dict[str, Any], stride: int) -> dict[str, Any]:
    """An episode with its frames as sheets of WebP instead of arrays."""
    views = [_sheets(view, frames[::stride]) for view, frames in part["frames"].items()]
    return {name: value for name, value in part.items() if name != "frames"} | {"views": views, "stride": stride}


def _sheets(view: str, frames: np.ndarray) -> dict[str, Any]:
    """Frames (frame, height, width, 3) in rows on as few sheets as they need."""
    _, height, width, _ = frames.shape
    columns, rows = max(1, SHEET_SIDE // width), max(1, SHEET_SIDE // height)
    columns = min(columns, math.ceil(math.sqrt(len(frames))))
    count = columns * rows
    parts = [frames[first : first + count] for first in range(0, len(frames), count)]
    sheets = [_webp(_tiled(part, columns)) for part in parts]
    return {"name": view, "width": width, "height": height, "columns": columns, "rows": rows, "sheets": sheets}


def _tiled(frames: np.ndarray, columns: int) -> np.ndarray:
    """(frame, h, w, 3) -> one picture with so many frames in a row; the last row is filled with black."""
    rows = math.ceil(len(frames) / columns)
    padded = np.pad(frames, ((0, rows * columns - len(frames)), (0, 0), (0, 0), (0, 0)))
    height, width = frames.shape[1:3]
    tiles = padded.reshape(rows, columns, height, width, 3).swapaxes(1, 2)
    return tiles.reshape(rows * height, columns * width, 3)


def _webp(picture: np.ndarray) -> str:
    """A picture as a data URL."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "WEBP", quality=WEBP_QUALITY, method=4)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
