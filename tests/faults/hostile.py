"""Hostile files, made from valid ones by hypothesis, and what takes them, with a bound on memory and time.

A case is a few files of a folder that is otherwise sound. Whoever takes it may refuse it with a DmcvbError or accept
it; it may not raise anything else, run a program, write outside the case's folder, take a gigabyte or ten seconds.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import json
import os
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import traceback
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import imageio_ffmpeg
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.distractors.backgrounds import load_backgrounds
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.generate.plan import make_plan
from dmcvb_gen.generate.recipe import expand, load_recipe
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.release.import_tfds import import_tfds
from dmcvb_gen.release.tfrecord import encode_example, record
from dmcvb_gen.storage.store import open_store
from dmcvb_gen.tasks import get_task
from tests.dataset import made_up

MEMORY, SECONDS = 10**9, 10.0
"""What refusing a case may take."""
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


def _at(tree: Any, path: tuple) -> Any:
    return functools.reduce(lambda inner, key: inner[key], path, tree)


@st.composite
def changed_tree(draw, tree: Any) -> Any:
    """A tree with one to three of its values replaced, taken out, multiplied, or swapped for another one."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(places(tree)[1:] or [()]))
        if not path:
            return copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        key, parent, old = path[-1], _at(tree, path[:-1]), _at(tree, path)
        action = draw(st.sampled_from(["replace", "replace", "near", "delete", "add", "swap"]))
        if action == "delete":
            del parent[key]
        elif action == "swap":
            parent[key] = copy.deepcopy(_at(tree, draw(st.sampled_from(places(tree)))))
        elif action == "near" and isinstance(old, (int, float)) and not isinstance(old, bool):
            parent[key] = old * draw(st.sampled_from([-1, 2, 1000, 10**6, 10**12])) + draw(st.integers(-2, 2))
        elif action == "add":
            parent[key] = old | {"x": 1} if isinstance(old, dict) else [old] * draw(st.sampled_from([0, 2, 1000]))
        else:
            parent[key] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
    return tree


@st.composite
def changed_bytes(draw, data: bytes) -> bytes:
    """Bytes cut short, doubled, or with others put in or over them."""
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, max(0, len(out) - 1)))
        junk = draw(st.one_of(st.binary(max_size=20), st.sampled_from([b"\xff" * 8, b"\x7f\xff\xff\xff", b"\0" * 8])))
        action = draw(st.sampled_from(["cut", "insert", "overwrite", "repeat"]))
        if action == "cut":
            del out[place:]
        elif action == "repeat":
            out += out[place : place + 1000] * draw(st.integers(1, 3))
        else:
            out[place : place + len(junk) * (action == "overwrite")] = junk
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


WALKERS = {"tasks": ["walker-walk", "cheetah-run"], "levels": ["random"], "settings": ["none", "static", "dynamic"]}
MAZES = {"tasks": "ant-maze-empty7x7", "levels": ["random"], "settings": ["fixed"]}
MAZES |= {"fixed_goals": 2, "episodes_per_goal": 2}
RECIPE = {"name": "small", "version": "1.0.0", "seed": 3, "size": 16}
RECIPE |= {"subsets": [WALKERS | {"episodes": 3, "episodes_per_shard": 2}, MAZES]}
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
def valid_policy() -> Files:
    return {"p.safetensors": Path(resolve_policies("walker-walk", "expert", None)[0]).read_bytes()}


@st.composite
def changed_policy(draw) -> Files:
    """A policy file with other headers: the tensors' (safetensors) or the policy's own, lying about shapes."""
    [(name, data)] = valid_policy().items()
    if draw(st.booleans()):
        return {name: draw(changed_bytes(data[:3000])) + data[3000:]}
    size = int.from_bytes(data[:8], "little")
    outer = json.loads(data[8 : 8 + size])
    if draw(st.booleans()):
        outer["__metadata__"]["header"] = json.dumps(draw(changed_tree(json.loads(outer["__metadata__"]["header"]))))
    else:
        outer = draw(changed_tree(outer))
    text = json.dumps(outer).encode()
    length = draw(st.sampled_from([len(text), len(text), len(text), 2**62, 0, len(text) + 7]))
    return {name: struct.pack("<Q", length) + text + data[8 + size :]}


@functools.cache
def valid_tfds() -> Files:
    """A TFDS folder of one episode of two steps, as the exporter of RLDS lays them out."""
    task, picture, rows = get_task("walker-walk"), io.BytesIO(), 3
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(picture, "PNG")
    values: dict[str, Any] = {"observation/pixels": [picture.getvalue()] * rows}
    for name, part in task.state_slices.items():
        values[f"observation/{name}"] = np.full(rows * (part.stop - part.start), 0.5, np.float32)
    values |= {"action": np.full(rows * task.action_size, 0.1, np.float32), "reward": np.ones(rows, np.float32)}
    values["is_terminal"] = np.zeros(rows, np.int64)
    observed = dict.fromkeys(task.state_slices, {"tensor": {}})
    observed["pixels"] = {"image": {"shape": {"dimensions": ["8", "8", "3"]}}}
    tree = dict.fromkeys(("action", "reward", "is_terminal"), {"tensor": {}})
    tree["observation"] = {"featuresDict": {"features": observed}}
    steps = {"sequence": {"feature": {"featuresDict": {"features": tree}}}}
    described = {"featuresDict": {"features": {"steps": steps}}}
    data = record(encode_example({f"steps/{name}": value for name, value in values.items()}))
    return {"in/features.json": json.dumps(described).encode(), "in/d-train.tfrecord-00000-of-00001": data}


@st.composite
def changed_tfds(draw) -> Files:
    """Other features, other records; also records whose checksums fit, as a hostile hand would make them."""
    files = dict(valid_tfds())
    name = draw(st.sampled_from(sorted(files)))
    if name == "in/features.json":
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
    frames, out = [Image.fromarray(np.full((16, 16, 3), 60 * i, np.uint8)) for i in range(4)], {}
    for kind in ("png", "bmp", "gif", "webp"):
        data = io.BytesIO()
        more = {"save_all": True, "append_images": frames[1:]} if kind in ("gif", "webp") else {}
        frames[0].save(data, kind, **more)
        out[f"a.{kind}"] = data.getvalue()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *"-v error -f lavfi -i testsrc=size=32x32:rate=5:duration=1".split()]
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("mp4", "mkv"):
            subprocess.run([*command, f"{folder}/a.{kind}"], check=True, stdin=subprocess.DEVNULL)
            out[f"a.{kind}"] = Path(f"{folder}/a.{kind}").read_bytes()
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
    release = Release.open(str(folder))
    assert release.recipes
    for subset in release.subsets.values():
        for array in subset.arrays:  # of every shard at once
            subset.read(array)
        subset.episode(int(subset.episodes[0]), ["action"])


def take_recipe(folder: Path) -> None:
    recipe = load_recipe(folder / "recipe.yaml")
    expand(recipe)
    make_plan(recipe, folder / "out")


def take_policy(folder: Path) -> None:
    task = get_task("walker-walk")
    policy = load_policy(folder / "p.safetensors", task)
    policy.act(np.zeros((2, task.behaviour_size), np.float32), [np.random.default_rng(i) for i in range(2)])


def take_tfds(folder: Path) -> None:
    import_tfds(folder / "in", folder / "out", task="walker-walk", level="expert", setting="none")


def take_backgrounds(folder: Path) -> None:
    videos = load_backgrounds(folder, "train")
    for video in range(len(videos)):
        videos.frames(video)


# -- kinds -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of input: `base` are sound files around it, `cases` gives the hostile ones, `take` reads them."""

    cases: Callable[[], st.SearchStrategy[Files]]
    take: Callable[[Path], None]
    base: Callable[[], Files] = dict


def _sealed(name: str, data: bytes) -> Files:
    """A changed file with the files that name it changed accordingly, as the author of a release can do."""
    folder, old, new = name.split("/")[0], sha256_bytes(valid_release()[name]).encode(), sha256_bytes(data)
    if folder == "recipes":
        return {f"recipes/{new}.json": data}
    if folder == "layers":
        named = valid_release()["manifest.json"].replace(old, new.encode())
        return {f"layers/{new}.json": data, "manifest.json": named}
    for path, text in valid_release().items():
        if path.startswith("layers/") and old in text:
            facts = re.compile(rb'"bytes":\d+,"sha256":"' + old)
            return {name: data} | _sealed(path, facts.sub(b'"bytes":%d,"sha256":"%s' % (len(data), new.encode()), text))
    return {name: data}


def _one_of_release(start: str, inside: str = "") -> Callable[[], st.SearchStrategy[Files]]:
    """Cases of one changed file of a release, whose path begins so and has that in it."""

    def changed(name: str) -> st.SearchStrategy[Files]:
        change = changed_json if name.endswith(".json") else changed_bytes
        return change(valid_release()[name]).map(lambda data: _sealed(name, data))

    def cases() -> st.SearchStrategy[Files]:
        return st.one_of([changed(name) for name in valid_release() if name.startswith(start) and inside in name])

    return cases


def _unfinished(without: str = "manifest.json") -> Files:
    return {name: data for name, data in valid_release().items() if not name.startswith(("manifest.json", without))}


def _recipes() -> st.SearchStrategy[Files]:
    text = st.one_of(changed_json(json.dumps(RECIPE).encode()), st.sampled_from(YAML_BOMBS))
    return text.map(lambda data: {"recipe.yaml": data})


KINDS: dict[str, Kind] = {
    "manifest": Kind(_one_of_release("manifest.json"), take_release, valid_release),
    "list": Kind(_one_of_release("layers/"), take_release, valid_release),
    "record": Kind(_one_of_release("records/"), take_release, _unfinished),
    "resolved": Kind(_one_of_release("recipes/"), take_release, lambda: _unfinished("recipes/")),
    "chunk": Kind(_one_of_release("hop/", "/c/"), take_release, valid_release),
    "recipe": Kind(_recipes, take_recipe, lambda: {"recipe.yaml": json.dumps(RECIPE).encode()}),
    "policy": Kind(changed_policy, take_policy, valid_policy),
    "tfds": Kind(changed_tfds, take_tfds, valid_tfds),
    "backgrounds": Kind(changed_pictures, take_backgrounds),
}


# -- taking them, under bounds ------------------------------------------------------------------------------------


class _Guard:
    """An audit hook that notes what no input may bring about, while there is a folder that cases are in."""

    FORBIDDEN = {"os.system", "os.exec", "os.posix_spawn", "pickle.find_class", "socket.connect", "ctypes.dlopen"}
    CHANGES = {"os.mkdir", "os.remove", "os.rename", "os.link", "os.symlink", "os.rmdir", "shutil.rmtree"}

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
            if isinstance(arguments[0], (str, bytes, os.PathLike)):
                self._inside(os.fsdecode(arguments[0]), event)
        elif event in self.CHANGES:
            path = os.fsdecode(arguments[0])
            if event in ("os.remove", "os.rmdir", "os.mkdir") and arguments[-1] != -1:  # relative to an open folder
                path = os.path.join(os.readlink(f"/proc/self/fd/{arguments[-1]}"), path)
            self._inside(path, event)
        elif event in self.FORBIDDEN or (event == "subprocess.Popen" and "ffmpeg" not in str(arguments[0])):
            self.noted.append(f"{event} {arguments[:2]}")

    def _inside(self, path: str, event: str) -> None:
        allowed = (self.folder, tempfile.gettempdir() + "/tmp", "/dev/null")
        if not os.path.realpath(path).startswith(allowed):
            self.noted.append(f"{event} {path}")


@functools.cache
def _guard() -> _Guard:
    """The hook of this process; Python removes none."""
    guard = _Guard()
    sys.addaudithook(guard)
    return guard


def _lay(folder: Path, files: Files) -> None:
    """Make a folder hold these files and nothing else."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


@contextlib.contextmanager
def _bounds(guard: _Guard, folder: Path) -> Iterator[None]:
    """Bounds on memory and time, and the guard, for what is done inside."""
    handlers = {number: signal.signal(number, guard.too_late) for number in (signal.SIGALRM, signal.SIGPROF)}
    limit, pages = resource.getrlimit(resource.RLIMIT_AS), int(Path("/proc/self/statm").read_text().split()[0])
    guard.folder, guard.noted, guard.late = str(folder), [], False
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, limit[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # the processor's time: the machine may be busy
    signal.alarm(60)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        guard.folder = None
        resource.setrlimit(resource.RLIMIT_AS, limit)
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _take(take: Callable[[Path], None], folder: Path) -> str | None:
    """What went wrong while a case was taken; None if nothing did."""
    guard, wrong = _guard(), None
    try:
        with _bounds(guard, folder):
            take(folder)
    except DmcvbError as error:
        wrong = f"a refusal of several lines: {error}" if "\n" in str(error) else None
    except Exception:
        wrong = traceback.format_exc()[-3000:]
    if guard.noted:
        return f"it did {guard.noted[:3]}"
    return f"it took over {SECONDS:.0f} s" if wrong is None and guard.late else wrong


def run_kind(kind: Kind, examples: int, folder: Path) -> dict[str, str]:
    """Take `examples` cases of a kind in a folder; each way in which one went wrong, with the first such case."""
    ways: dict[str, str] = {}
    base = kind.base()
    _lay(folder, base)
    with contextlib.suppress(DmcvbError, OSError):
        kind.take(folder)  # what is imported or made once for all counts for none
    lasting = settings(deadline=None, suppress_health_check=list(HealthCheck), database=None, phases=[Phase.generate])

    @hypothesis.seed(0)
    @settings(lasting, max_examples=examples)
    @given(kind.cases())
    def every(files):
        _lay(folder, base | files)
        if wrong := _take(kind.take, folder):
            shown = {name: data if len(data) < 600 else data[:600] + b"..." for name, data in files.items()}
            ways.setdefault(wrong.strip().splitlines()[-1][:100], f"{wrong}\nof {shown}")

    every()
    return ways
