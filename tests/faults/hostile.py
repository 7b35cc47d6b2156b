"""Hostile files, made from valid ones by hypothesis, and what takes them, in a child with a bound on memory and time.

    python -m tests.faults.hostile --examples 500                  # every kind
    python -m tests.faults.hostile --examples 500 --seed 7 manifest policy

A case is a few files of a folder that is otherwise sound. Whoever takes it may refuse it with a DmcvbError or accept
it; it may not raise anything else, run a program, write outside the case's folder, take a gigabyte or ten seconds.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import copy
import functools
import io
import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hypothesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from dmcvb_gen.storage.store import open_store
from tests.dataset import made_up

MEMORY, SECONDS = 10**9, 10.0
"""What refusing a case may take."""
TOP = Path(__file__).parents[2]
Files = dict[str, bytes]

# -- changing valid files ----------------------------------------------------------------------------------

HOSTILE = (
    *(None, True, -1, 0, 1, 2**31, 2**53, 2**63, 2**64, 10**18, -(10**18), 1e308, 0.5, float("nan"), float("inf")),
    *("", "x" * 100_000, "../../evil", "/tmp/evil", "a/../../b", "\0", "\ud800", "a\nb", "file:///etc/passwd", "~/x"),
    *([], {}, [0], ["x"] * 5000, {"x": {"x": {"x": []}}}, [[[[[]]]]], {"__class__": "os.system"}, [10**9] * 3),
)
"""Values that somebody with bad intentions, or a broken program, might put anywhere."""


def places(tree: Any, path: tuple = ()) -> list[tuple]:
    """The path of every value in a tree of lists and dictionaries."""
    found = [path]
    if isinstance(tree, dict):
        for key, value in tree.items():
            found += places(value, (*path, key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree[:20]):
            found += places(value, (*path, index))
    return found


@st.composite
def changed_tree(draw, tree: Any) -> Any:
    """A tree with one to three of its values replaced, taken out, or given company."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(places(tree)[1:] or [()]))
        if not path:
            return copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        parent = functools.reduce(lambda inner, key: inner[key], path[:-1], tree)
        action = draw(st.sampled_from(["replace", "replace", "replace", "near", "delete", "add", "swap"]))
        old = parent[path[-1]]
        if action == "delete":
            del parent[path[-1]]
        elif action == "add":
            if isinstance(old, dict):
                old[draw(st.sampled_from(["x", "__proto__", "extends", "format"]))] = copy.deepcopy(
                    draw(st.sampled_from(HOSTILE))
                )
            else:
                parent[path[-1]] = [old] * draw(st.sampled_from([0, 1, 2, 1000]))
        elif action == "near" and isinstance(old, (int, float)) and not isinstance(old, bool):
            parent[path[-1]] = old * draw(st.sampled_from([-1, 2, 1000, 10**6, 10**12])) + draw(st.integers(-2, 2))
        elif action == "swap":
            other = draw(st.sampled_from(places(tree)))
            parent[path[-1]] = copy.deepcopy(functools.reduce(lambda inner, key: inner[key], other, tree))
        else:
            parent[path[-1]] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
    return tree


@st.composite
def changed_bytes(draw, data: bytes) -> bytes:
    """Bytes cut short, flipped, doubled, or with others put in."""
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, max(0, len(out) - 1)))
        action = draw(st.sampled_from(["flip", "cut", "insert", "overwrite", "repeat"]))
        if action == "flip" and out:
            out[place] ^= draw(st.integers(1, 255))
        elif action == "cut":
            del out[place:]
        elif action == "insert":
            out[place:place] = draw(st.binary(max_size=20))
        elif action == "overwrite":
            junk = draw(st.sampled_from([b"\xff" * 4, b"\0" * 8, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\0\0\0\x80"]))
            out[place : place + len(junk)] = junk
        else:
            out += out[place : place + 1000] * draw(st.integers(1, 3))
    return bytes(out)


NESTED = [opening * 100_000 for opening in ("[", '{"a":')] + ['{"a":' * 900 + "1" + "}" * 900]
JSON_BOMBS = [text.encode() for text in [*NESTED, "1" * 5000, "\ufeff{}", '"\\ud800"', "nul"]] + [b"\xff\xfe\0", b""]


def changed_json(data: bytes) -> st.SearchStrategy[bytes]:
    tree = changed_tree(json.loads(data)).map(lambda value: json.dumps(value).encode())
    return st.one_of(tree, tree, tree, changed_bytes(data), st.sampled_from(JSON_BOMBS))


# -- valid files -------------------------------------------------------------------------------------------


@functools.cache
def valid_release() -> Files:
    """A tiny release of made-up numbers."""
    with tempfile.TemporaryDirectory() as folder:
        made_up.make(open_store(folder), made_up.recipe(3))
        root = Path(folder)
        return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


RECIPE = """
name: small
version: 1.0.0
seed: 3
size: 16
subsets:
  - tasks: [walker-walk, cheetah-run]
    levels: [random]
    settings: [none, static, dynamic]
    episodes: 3
    episodes_per_shard: 2
  - tasks: ant-maze-empty7x7
    levels: [random]
    settings: [fixed]
    fixed_goals: 2
    episodes_per_goal: 2
"""
_NINE = b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n"
YAML_BOMBS = [
    b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(_NINE % (c + 1, c + 1, *[c] * 9) for c in range(97, 107)),
    b"name: x\nsubsets: &a [*a]\n",
    b"!!python/object/apply:os.system ['touch /tmp/evil']\n",
    b"name: !!python/name:os.system\nsubsets: []\n",
    b"[" * 20_000,
    b"{a: " * 3_000,
    b"- " * 20_000,
    b"name: x\nsubsets: [{tasks: walker-walk, levels: random, settings: none, steps: 1e400}]",
    b"\xff\xfe\x00",
    b"%YAML 9.9\n---\n",
    b"? {? {}}\n",
]


@functools.cache
def valid_policy() -> bytes:
    from dmcvb_gen.policies.bundled import resolve_policies

    return Path(resolve_policies("walker-walk", "expert", None)[0]).read_bytes()


@st.composite
def changed_policy(draw) -> bytes:
    """A policy file with other headers: the tensors' (safetensors) or the policy's own, lying about shapes."""
    data = valid_policy()
    if draw(st.booleans()):
        return draw(changed_bytes(data[:3000])) + data[3000:]
    size = int.from_bytes(data[:8], "little")
    outer = json.loads(data[8 : 8 + size])
    if draw(st.booleans()):
        outer["__metadata__"]["header"] = json.dumps(draw(changed_tree(json.loads(outer["__metadata__"]["header"]))))
    else:
        outer = draw(changed_tree(outer))
    text = json.dumps(outer).encode()
    length = draw(st.sampled_from([len(text), len(text), len(text), 2**62, 0, len(text) + 7]))
    return struct.pack("<Q", length) + text + data[8 + size :]


@functools.cache
def valid_tfds() -> Files:
    """A TFDS folder of one episode of two steps, as the exporter of RLDS lays them out."""
    import numpy as np
    from PIL import Image

    from dmcvb_gen.release.tfrecord import encode_example, record
    from dmcvb_gen.tasks import get_task

    task, picture, steps = get_task("walker-walk"), io.BytesIO(), 3
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(picture, "PNG")
    values: dict[str, Any] = {"observation/pixels": [picture.getvalue()] * steps}
    for name, part in task.state_slices.items():
        values[f"observation/{name}"] = np.full(steps * (part.stop - part.start), 0.5, np.float32)
    values |= {"action": np.full(steps * task.action_size, 0.1, np.float32), "reward": np.ones(steps, np.float32)}
    values["is_terminal"] = np.zeros(steps, np.int64)
    tree: dict[str, Any] = {}
    for name in values:
        inner = tree
        *parents, last = name.split("/")
        for parent in parents:
            inner = inner.setdefault(parent, {"featuresDict": {"features": {}}})["featuresDict"]["features"]
        inner[last] = {"image": {"shape": {"dimensions": ["8", "8", "3"]}}} if last == "pixels" else {"tensor": {}}
    described = {
        "featuresDict": {"features": {"steps": {"sequence": {"feature": {"featuresDict": {"features": tree}}}}}}
    }
    data = record(encode_example({f"steps/{name}": value for name, value in values.items()}))
    return {"features.json": json.dumps(described).encode(), "d-train.tfrecord-00000-of-00001": data}


@st.composite
def changed_tfds(draw) -> Files:
    """Other features, other records; also records whose checksums fit, as a hostile hand would make them."""
    from dmcvb_gen.release.tfrecord import record

    files = dict(valid_tfds())
    name = draw(st.sampled_from(sorted(files)))
    if name == "features.json":
        return files | {name: draw(changed_json(files[name]))}
    if draw(st.booleans()):
        return files | {name: draw(changed_bytes(files[name]))}
    return files | {name: record(draw(changed_bytes(files[name][12:-4])))}


def png(width: int, height: int, data: bytes = b"") -> bytes:
    """A PNG that says it is so large, whatever is in it."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@functools.cache
def valid_pictures() -> Files:
    """Backgrounds: pictures, a GIF, a WebP and a video, each small."""
    import imageio_ffmpeg
    import numpy as np
    from PIL import Image

    frames = [Image.fromarray(np.full((16, 16, 3), 60 * i, np.uint8)) for i in range(4)]
    out: Files = {}
    for suffix in ("png", "jpg", "bmp", "gif", "webp"):
        data = io.BytesIO()
        kind = {"jpg": "JPEG"}.get(suffix, suffix.upper())
        more = {"save_all": True, "append_images": frames[1:]} if suffix in ("gif", "webp") else {}
        frames[0].save(data, kind, **more)
        out[f"a.{suffix}"] = data.getvalue()
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-f",
        "lavfi",
        "-i",
        "testsrc=size=32x32:rate=5:duration=1",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for suffix in ("mp4", "avi", "mkv"):
            subprocess.run([*command, f"{folder}/a.{suffix}"], check=True, stdin=subprocess.DEVNULL)
            out[f"a.{suffix}"] = Path(f"{folder}/a.{suffix}").read_bytes()
    return out


def endless_gif(frames: int = 200_000) -> bytes:
    """A GIF of very many tiny frames on a screen of 60,000 x 60,000."""
    head = b"GIF89a" + struct.pack("<HHBBB", 60_000, 60_000, 0x80, 0, 0) + b"\0\0\0\xff\xff\xff"
    frame = b"\x2c" + struct.pack("<HHHHB", 0, 0, 1, 1, 0) + b"\x02\x02\x44\x01\0"
    return head + frame * frames + b"\x3b"


PICTURE_BOMBS: list[Files] = [
    {"a.png": png(100_000, 100_000)},
    {"a.png": png(100_000, 100_000, zlib.compress(b"\0" * 10**7))},
    {"a.png": png(12_000, 12_000, zlib.compress(b"\0" * (36_001 * 12_000), 1))},
    {"a.png": png(2**31 - 1, 1)},
    {"a.png": png(0, 0)},
    {"a.bmp": b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 100_000, 100_000, 1, 24, 0, 0, 0, 0, 0, 0)},
    {"a.gif": endless_gif()},
    {"a.gif": endless_gif(3)},
    {"a.mp4": b"\0\0\0\x18ftypmp42" + b"\xff" * 5000},
    {"a.mp4": b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n"},
    {"a.mkv": b"ffconcat version 1.0\nfile /etc/passwd\n"},
    {"a.avi": b"RIFF\xff\xff\xff\xffAVI LIST\xff\xff\xff\xffhdrlavih8\0\0\0" + b"\xff" * 200},
    {"a.webp": b"RIFF\xff\xff\xff\xffWEBPVP8X\x0a\0\0\0\x02\0\0\0" + b"\xff" * 6},
    {"a.png": b"P6\n100000 100000\n255\n"},
]


@st.composite
def changed_pictures(draw) -> Files:
    if draw(st.integers(0, 9)) == 0:
        return draw(st.sampled_from(PICTURE_BOMBS))
    files = valid_pictures()
    name = draw(st.sampled_from(sorted(files)))
    data = files[name]
    if name.endswith(".png") and draw(st.booleans()):
        side = st.sampled_from([0, 1, 7, 5000, 20_000, 100_000, 2**31 - 1])
        return {name: png(draw(side), draw(side), data[-100:])}
    head = draw(st.integers(50, max(51, len(data))))
    return {name: draw(changed_bytes(data[:head])) + data[head:]}


# -- takers: what reads each kind, given the folder that a case is in -------------------------------------------


def take_release(folder: Path) -> None:
    from dmcvb_gen.dataset import Release

    release = Release.open(str(folder))
    assert release.recipes
    for subset in release.subsets.values():
        for array in subset.arrays:  # of every shard at once
            subset.read(array)
        subset.episode(int(subset.episodes[0]), ["action"])


def take_recipe(folder: Path) -> None:
    from dmcvb_gen.generate.plan import make_plan
    from dmcvb_gen.generate.recipe import expand, load_recipe

    recipe = load_recipe(folder / "recipe.yaml")
    expand(recipe)
    make_plan(recipe, folder / "out")


def take_policy(folder: Path) -> None:
    import numpy as np

    from dmcvb_gen.policies.policy_file import load_policy
    from dmcvb_gen.tasks import get_task

    task = get_task("walker-walk")
    policy = load_policy(folder / "p.safetensors", task)
    policy.act(np.zeros((2, task.behaviour_size), np.float32), [np.random.default_rng(i) for i in range(2)])


def take_card(folder: Path) -> None:
    from dmcvb_gen.release.card import check_card

    check_card(folder)


def take_tfds(folder: Path) -> None:
    from dmcvb_gen.release.import_tfds import import_tfds

    import_tfds(folder / "in", folder / "out", task="walker-walk", level="expert", setting="none")


def take_backgrounds(folder: Path) -> None:
    from dmcvb_gen.distractors.backgrounds import load_backgrounds

    videos = load_backgrounds(folder, "train")
    for video in range(len(videos)):
        videos.frames(video)


def take_published(folder: Path) -> None:
    from dmcvb_gen.release.fetch import fetch

    fetch(f"file://{folder}/there", folder / "deep/down/here", workers=1)
    take_release(folder / "deep/down/here")


def take_names(folder: Path) -> None:
    """A URL, a subset's name and a pattern out of names.json, each given to whoever takes such."""
    from dmcvb_gen.dataset.manifest import check_relative_path
    from dmcvb_gen.errors import DmcvbError
    from dmcvb_gen.release.export import export
    from dmcvb_gen.release.fetch import fetch

    name = json.loads((folder / "names.json").read_bytes())
    calls: list[Callable[[], Any]] = [
        lambda: open_store(name),
        lambda: fetch(f"file://{folder}/there", folder / "here", [name], workers=1),
        lambda: export(str(folder / "there"), name, folder / "exported"),
        lambda: export(str(folder / "there"), "npz", folder / "exported", [name]),
    ]
    for call in calls:
        try:
            call()
        except DmcvbError:
            pass
    try:
        kept = check_relative_path(name)
    except ValueError:
        return
    inside = (folder / kept).resolve()
    assert inside.is_relative_to(folder.resolve()), f"{kept} leaves its folder"


# -- kinds -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of input: `base` are sound files around it, `cases` gives the hostile ones, `take` reads them."""

    cases: Callable[[], st.SearchStrategy[Files]]
    take: Callable[[Path], None]
    base: Callable[[], Files] = dict


def _one_of_release(choose: Callable[[str], bool], prefix: str = "") -> Callable[[], st.SearchStrategy[Files]]:
    def cases():
        names = sorted(name for name in valid_release() if choose(name))
        changed = [
            (changed_json if name.endswith(".json") else changed_bytes)(valid_release()[name]).map(
                lambda data, name=name: {prefix + name: data}
            )
            for name in names
        ]
        return st.one_of(changed)

    return cases


def _unfinished() -> Files:
    return {name: data for name, data in valid_release().items() if name != "manifest.json"}


def _published() -> Files:
    return {f"there/{name}": data for name, data in valid_release().items()}


def _names() -> st.SearchStrategy[Files]:
    parts = st.sampled_from(
        ["..", ".", "", "a", "~", "/", "\\", "\0", "%2e%2e", "c:", "evil", "file:", "s3:", "hf:", "*"]
    )
    made = st.lists(parts, max_size=8).map("/".join)
    urls = st.sampled_from(["hf://datasets/../../x", "file:///etc", "s3://", "://", "a://b", "simplecache::file:///x"])
    text = st.one_of(made, made, urls, st.text(max_size=50), st.sampled_from(["[" * 1000, "*" * 300, "x" * 5000]))
    return text.map(lambda name: {"names.json": json.dumps(name).encode()})


CARD = {"README.md": b"# x\n", "croissant.json": b"{}", "CHANGELOG.md": b"## 1.0.0\n", "card/returns.png": png(1, 1)}


@st.composite
def _card(draw) -> Files:
    name = draw(st.sampled_from(["README.md", "croissant.json", "CHANGELOG.md", "card/contact_sheet.png"]))
    if name.endswith(".png"):
        return {name: next(iter(draw(changed_pictures()).values()))}
    return {
        name: draw(st.one_of(st.binary(max_size=200), changed_bytes(CARD[name] * 100), st.sampled_from(JSON_BOMBS)))
    }


def _with(prefix: str, files: st.SearchStrategy[Files]) -> st.SearchStrategy[Files]:
    return files.map(lambda case: {prefix + name: data for name, data in case.items()})


def _recipes() -> st.SearchStrategy[Files]:
    import yaml

    tree = changed_tree(yaml.safe_load(RECIPE)).map(lambda value: json.dumps(value).encode())
    text = st.one_of(tree, tree, tree, changed_bytes(RECIPE.encode()), st.sampled_from(YAML_BOMBS))
    return text.map(lambda data: {"recipe.yaml": data})


KINDS: dict[str, Kind] = {
    "manifest": Kind(_one_of_release(lambda name: name == "manifest.json"), take_release, valid_release),
    "list": Kind(_one_of_release(lambda name: name.startswith("layers/")), take_release, valid_release),
    "record": Kind(_one_of_release(lambda name: name.startswith("records/")), take_release, _unfinished),
    "resolved": Kind(_one_of_release(lambda name: name.startswith("recipes/")), take_release, _unfinished),
    "chunk": Kind(_one_of_release(lambda name: "/c/" in name), take_release, valid_release),
    "published": Kind(_one_of_release(lambda name: name.endswith(".json"), "there/"), take_published, _published),
    "recipe": Kind(_recipes, take_recipe, lambda: {"recipe.yaml": RECIPE.encode()}),
    "policy": Kind(
        lambda: changed_policy().map(lambda data: {"p.safetensors": data}),
        take_policy,
        lambda: {"p.safetensors": valid_policy()},
    ),
    "card": Kind(_card, take_card, lambda: valid_release() | CARD),
    "tfds": Kind(
        lambda: _with("in/", changed_tfds()),
        take_tfds,
        lambda: {f"in/{name}": data for name, data in valid_tfds().items()},
    ),
    "backgrounds": Kind(changed_pictures, take_backgrounds),
    "names": Kind(_names, take_names, _published),
}


# -- the child that takes them -----------------------------------------------------------------------------------


class Taker:
    """A child that takes cases, one after the other, under a bound on its memory; another follows if it dies."""

    def __init__(self):
        self._process: subprocess.Popen | None = None

    def __enter__(self) -> Taker:
        return self

    def __exit__(self, *_) -> None:
        if self._process:
            self._process.stdin.close()
            self._process.wait(timeout=60)

    def _start(self) -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(TOP), os.environ.get("PYTHONPATH", "")])}
        command = [sys.executable, "-m", "tests.faults.hostile", "--serve"]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment, cwd=TOP)

    def take(self, kind: str, files: Files) -> dict[str, Any]:
        """status ("refused", "accepted", "wrong", "died"), text, and what it took: seconds, bytes."""
        self._process = self._process or self._start()
        case = {name: base64.b64encode(data).decode() for name, data in files.items()}
        self._process.stdin.write(json.dumps([kind, case]) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            self._process = None
            return {"status": "died", "text": "the process died", "seconds": 0.0, "bytes": 0}
        answer = json.loads(line)
        if answer["seconds"] > SECONDS:
            answer |= {"status": "wrong", "text": f"{answer['text']}\ntook {answer['seconds']:.0f} s"}
        if answer["bytes"] > MEMORY:
            answer |= {"status": "wrong", "text": f"{answer['text']}\ntook {answer['bytes'] / 1e6:.0f} MB"}
        return answer


def _memory(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024
    raise KeyError(name)


class _Guard:
    """An audit hook that notes what no input may bring about."""

    def __init__(self):
        self.folder, self.noted, self.late = None, [], False

    def too_late(self, *_) -> None:
        """A handler of the alarms. What is at work may take its error for one of the storage, so it is noted too."""
        self.late = True
        raise TimeoutError("it took too long")

    def __call__(self, event: str, arguments: tuple) -> None:
        if self.folder is None:
            return
        if event == "open" and (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            path = arguments[0]
            if isinstance(path, (str, bytes, os.PathLike)):
                self._inside(os.fsdecode(path), event)
        elif event in ("os.mkdir", "os.remove", "os.rename", "os.link", "os.symlink", "os.rmdir", "shutil.rmtree"):
            path = os.fsdecode(arguments[0])
            if event in ("os.remove", "os.rmdir", "os.mkdir") and arguments[-1] != -1:  # relative to an open folder
                path = os.path.join(os.readlink(f"/proc/self/fd/{arguments[-1]}"), path)
            self._inside(path, event)
        elif event in (
            "os.system",
            "os.exec",
            "os.posix_spawn",
            "pickle.find_class",
            "socket.connect",
            "ctypes.dlopen",
        ):
            self.noted.append(f"{event} {arguments}")
        elif event == "subprocess.Popen" and "ffmpeg" not in str(arguments[0]):
            self.noted.append(f"{event} {arguments[:2]}")

    def _inside(self, path: str, event: str) -> None:
        allowed = (self.folder, tempfile.gettempdir() + "/tmp", "/dev/null")
        if not os.path.realpath(path).startswith(allowed):
            self.noted.append(f"{event} {path}")


def serve() -> None:
    """Take cases from standard input, a line each: its kind and its files."""

    sys.dont_write_bytecode = True
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    guard, kind, base = _Guard(), None, dict[str, bytes]()
    signal.signal(signal.SIGALRM, guard.too_late)
    signal.signal(signal.SIGPROF, guard.too_late)
    sys.addaudithook(guard)
    with tempfile.TemporaryDirectory(prefix="hostile-") as outer:
        folder = Path(os.path.realpath(outer)) / "case"
        for line in iter(requests.readline, ""):
            asked, case = json.loads(line)
            if asked != kind:
                kind, base = asked, KINDS[asked].base()
                _warm_up(KINDS[kind], folder, base)
            _lay(folder, base | {name: base64.b64decode(data) for name, data in case.items()})
            answers.write(json.dumps(_take(KINDS[kind].take, folder, guard)) + "\n")
            answers.flush()


def _warm_up(kind: Kind, folder: Path, base: Files) -> None:
    """Take a sound case without bounds (what is imported or made once for all counts for none), then set them."""
    from dmcvb_gen.errors import DmcvbError

    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    _lay(folder, base)
    with contextlib.suppress(DmcvbError, OSError):
        kind.take(folder)
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + MEMORY, resource.RLIM_INFINITY))


def _lay(folder: Path, files: Files) -> None:
    """Make a folder hold these files and nothing else."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _take(take: Callable[[Path], None], folder: Path, guard: _Guard) -> dict[str, Any]:
    from dmcvb_gen.errors import DmcvbError

    Path("/proc/self/clear_refs").write_text("5")  # the high-water mark begins anew
    before, started = _memory("VmRSS"), time.process_time()
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    guard.folder, guard.noted, guard.late = str(folder), [], False
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # the processor's time: the machine may be busy
    signal.alarm(60)
    try:
        take(folder)
        status, text = "accepted", ""
    except DmcvbError as error:
        status, text = "refused", str(error)[:500]
        if "\n" in text:
            status, text = "wrong", f"a refusal of several lines: {text}"
    except BaseException:
        status, text = "wrong", traceback.format_exc()[-3000:]
    signal.setitimer(signal.ITIMER_PROF, 0)
    signal.alarm(0)
    guard.folder = None
    if guard.late and status != "wrong":
        status, text = "wrong", f"{text}\ntook over {SECONDS:g} s"
    if guard.noted:
        status, text = "wrong", f"it did {guard.noted[:3]}"
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = time.process_time() - started + after.ru_utime - children.ru_utime
    return {"status": status, "text": text, "seconds": seconds, "bytes": _memory("VmHWM") - before}


@dataclass
class Outcome:
    """What became of a kind's cases: how many were refused and accepted; each way in which one went wrong, once."""

    refused: int = 0
    accepted: int = 0
    slowest: float = 0.0
    most: int = 0
    wrong: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return (
            f"{self.refused} refused, {self.accepted} accepted, {len(self.wrong)} ways to go wrong; "
            f"at most {self.slowest:.2f} s and {self.most / 1e6:.0f} MB"
        )


def run_kind(taker: Taker, kind: str, examples: int, seed: int = 0) -> Outcome:
    """Give `examples` cases of a kind to a taker, the same ones for the same seed."""
    outcome = Outcome()

    @hypothesis.seed(seed)
    @settings(
        max_examples=examples,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        database=None,
        phases=[Phase.generate],
    )
    @given(KINDS[kind].cases())
    def every(files):
        answer = taker.take(kind, files)
        outcome.slowest, outcome.most = max(outcome.slowest, answer["seconds"]), max(outcome.most, answer["bytes"])
        if answer["status"] == "refused":
            outcome.refused += 1
        elif answer["status"] == "accepted":
            outcome.accepted += 1
        else:
            shown = {name: data if len(data) < 600 else data[:600] + b"..." for name, data in files.items()}
            way = answer["text"].strip().splitlines()[-1][:100]
            outcome.wrong.setdefault(way, f"{answer['text']}\nof {shown}")

    every()
    return outcome


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", help=f"{', '.join(KINDS)}; all by default")
    parser.add_argument("--examples", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return 0
    failed = 0
    with Taker() as taker:
        for kind in options.kinds or KINDS:
            outcome = run_kind(taker, kind, options.examples, options.seed)
            failed += bool(outcome.wrong)
            print(f"{kind}: {outcome}", *outcome.wrong.values(), sep="\n", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
