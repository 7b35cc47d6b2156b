"""Mistakes: one line that names the cure, exit code 2, and nothing written."""

from __future__ import annotations

import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.cli.common import parse_options
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.counts import LEAST_SHARE
from dmcvb_gen.options import with_parameters
from dmcvb_gen.policies.bundled import bundled_policies
from tests.conftest import TINY_MAZE, invoke

MAZE = "ant-maze-empty7x7"
ROLLOUTS = [
    ("", "give TASKs or --recipe"),
    ("walker-wlk", "Did you mean 'walker-walk'?"),
    ("ant-maze-empty", "Did you mean 'ant-maze-empty7x7'?"),
    ("walker-walk --level expert,medium", "unknown level 'expert,medium'"),
    ("walker-walk --distracter none", "--distractor"),
    ("walker-walk --distractor static_cue0.5", "has no cue or light"),
    ("walker-walk --distractor math:Nothing", "cannot find distractor math:Nothing"),
    ("walker-walk --distractor dis:Base", "dis.py has no 'Base'; if that is not your file, rename yours"),
    ("walker-walk --distractor a/mine.py:Base_hard", "is a file; in its folder, give mine:Base_hard"),
    ("walker-walk --distractor math:pi_hard", "is no distractor 'pi'"),
    ("walker-walk --distractor fog:My_Fog", "a difficulty follows an underscore, so classes have none"),
    ("walker-walk --size 0", "8 to 1024"),
    ("walker-walk --samples 3", "'--samples': '3' is not one of"),
    ("walker-walk --max-steps 99999999999", "--max-steps is 99999999999: Input should be less than or equal to 5000"),
    ("walker-walk --episodes-per-shard 9999", "--episodes-per-shard is 9999: Input should be less than"),
    ("--recipe=", "'--recipe' is empty; give a value"),
    ("walker-walk --renderer povray", "opengl"),
    ("walker-walk --range 5:2", "A < B"),
    ("walker-walk --range ²:³", "A < B"),
    ("walker-walk --workers 0", "--workers is '0'; give a number of processes, 1 or more, or ray"),
    ("walker-walk --distractor static --backgrounds empty", "holds no videos"),
    ("walker-walk --distractor static --backgrounds broken", "bad.mp4"),
    ("walker-walk --behaviour", "--behaviour"),
    ("walker-walk --behaviour truncated.safetensors", "not a whole policy file"),
    ("walker-walk --behaviour nan.safetensors", "not finite"),
    ("cheetah-run --behaviour walker.safetensors", "not for cheetah-run"),
    ("walker-walk --behaviour mine.py:swing", "is a file; in its folder, give mine:swing"),
    ("--recipe dmcvb-mni", "Did you mean 'dmcvb-mini'?"),
    ("--zzz", "see `dmcvb-gen rollout --help`"),
    ("hole.txt", "hole"),
    ("no-such.txt", "cannot read layout no-such.txt"),
    ("ring.txt --level expert", "`dmcvb-gen train-behaviour ring.txt`, then give --behaviour runs/ring"),
    ("ant-maze-easy7x7a --behaviour maze.safetensors", "knows the way of another layout; give one"),
    (f"{MAZE} --level mixed", "mazes have no mixed policies, as in the paper; ask for expert"),
    (f"{MAZE} --goal seen", "visible"),
    (f"{MAZE} --goal fixed --goal fixed3", "--goal fixed is given twice; keep one"),
    (f"{MAZE} --goal fixed0", "unknown goal"),
    (f"{MAZE} --goal fixed100000", "fixed goals"),
    (f"{MAZE} walker-walk", "mazes and locomotion tasks take different settings"),
    (f"{MAZE} --distractor dynamic", "no effect in mazes, which vary in style; ask for --goal"),
    (f"{MAZE} --backgrounds builtin", "no subset shows videos"),
    (f"{MAZE} --independent", "always have their own episodes"),
    ("walker-walk --goal hidden", "--goal is for mazes"),
    ("walker-walk --backgrounds builtin", "--distractor static or dynamic"),
    ("walker-walk --distractor dynamic_camera-light --split val", "shows videos"),
    ("walker-walk --level random --sample", "level random is always drawn"),
    ("walker-walk --behaviour mine:swing --sample", "a function of your own draws by itself"),
    ("--recipe dmcvb-mini walker-walk --distractor none --split val", "--distractor static or dynamic"),
    ("--recipe dmcvb-mini walker-walk --level random --sample", "level random is always drawn"),
]
OTHERS = [
    ("--fast", "see `dmcvb-gen --help`"),
    ("rolout", "Did you mean 'rollout'?"),
    ("info", "see `dmcvb-gen info --help`"),
    ("rollout walker-walk --level", "see `dmcvb-gen rollout --help`"),
    (f"rollout walker-walk --level random --out {'x' * 300}", "is too long for a folder's name"),
    ("rollout walker-walk --level random --out nowhere", "is a link to nothing"),
    ("rollout walker-walk --level random --out http://127.0.0.1:1/r", "can only be read; give a folder"),
    ("rollout walker-walk --level random --no-pixels --out hole.txt/r", "hole.txt is a file; choose another place"),
    ("info empty", "holds no release"),
    ("info r --option a=1 --option b=2 --json --json", "--option has no effect"),
    ("view r --out empty", "empty: it is a folder; name a file"),
    ("repaint r --size 16 --size 32 --out new", "--size is given twice, and takes one value"),
    (
        "rollout walker-walk --level random --max-steps 9 --seed 3 --out r",
        "has --max-steps 500, asked for 9; give it too, or",
    ),
    ("info s3://bucket/r --option nope=1", "keyword argument 'nope': the file system of s3://bucket"),
    ("evaluate-behaviour walker-walk --level random --sample", "level random is always drawn"),
    ("evaluate-behaviour --level random --behaviour walker.safetensors", "level random has no policy"),
    ("evaluate-behaviour walker-walk --behaviour mine:swing --sample", "a function of your own draws by itself"),
    ("evaluate-behaviour walker-walk --level exprt", "unknown level 'exprt'. Did you mean 'expert'?"),
    ("evaluate-behaviour --behaviour nothere", "neither a policy file, a run folder nor"),
    ("evaluate-behaviour hole.txt", "hole"),
    ("evaluate-behaviour math:nothing", "cannot find task math:nothing"),
    ("train-behaviour", "give a TASK, or the text file of a maze"),
    ("train-behaviour walker-walk --resume --out none", "holds no run to resume"),
    ("repaint r --only */none --split val --out new", "these subsets show no videos"),
    ("rollout --out r --seed 5", "TASKs or --recipe"),
    ("cluster part r 3/2", "K from 1 to N"),
    ("cluster part r ²/³", "K from 1 to N"),
    ("cluster begin walker-walk --level master --out new", "expert"),
    ("fetch s3:// --out new", "s3:// names no bucket; give s3://BUCKET/NAME"),
    ("fetch file:x --out s3://bucket/demo", "s3://bucket/demo is a URL; give a local one, a folder or file"),
    ("paint r --size 2000", "8 to 1024"),
    ("paint r --views nowhere", "unknown view"),
    ("paint r --only cheetah-run", "walker-walk/random/none"),
    ("regenerate", "give a RELEASE"),
    ("regenerate r --manifest quickstart", "give a RELEASE"),
    ("regenerate --manifest quickstart", "add --out"),
    ("regenerate --manifest quickstart --check", "remove --check: with --manifest or --out, digests"),
    ("regenerate --manifest quickstrat --out new", "unknown manifest"),
    ("regenerate --manifest no/m.json.xz --out new", "is no file"),
    ("regenerate r --check --out new", "remove --check"),
    ("regenerate r --out r", "remove --out"),
    ("regenerate r --check --range 7:9", "no subset has episodes 7:9"),
    ("rollout --out r --no-pixels", "--no-pixels has no effect: a release goes on as it was begun"),
    ("verify s3://bucket/r --workers ray", "--workers has no effect"),
    ("verify r --all", "--all has no effect"),
    ("verify r --option endpoint_url=http://127.0.0.1:1", "--option has no effect"),
    ("card r --check --url file:/x", "--check writes no card"),
    ("validate r --agents state-bc,bc --dino-weights x", "add --agents dino+bc"),
    ("validate r --benchmark b9", "unknown benchmark 'b9'"),
    ("validate r --only foo*", "unknown subset pattern 'foo*'"),
    ("publish r s3:/bucket/demo", "did you mean s3://bucket/demo?"),
    ("rollout walker-walk --out=", "'--out' is empty; give a value"),
]
PLACED = ["info r", "cluster finish r", "publish r mine", "fetch r --out mine", "export r --to hdf5 --out mine"]
OTHERS += [(f"{command} --option a=b", "is a folder") for command in PLACED]
WRITING = ["train-behaviour walker-walk --out", "import . --out"]
WRITING += ["export r --to hdf5 --out", *(f"{command} r --out" for command in ("validate", "preview", "card"))]
WRITING += [f"{command} r --out" for command in ("repaint", "regenerate")]
OTHERS += [(f"{command} s3://bucket/x", "s3://bucket/x is a URL; give a local one") for command in WRITING]


@pytest.fixture(scope="module")
def place(tmp_path_factory, small_release):
    """A folder with a release and files that are wrong in a way."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "r").symlink_to(small_release)
    (folder / "nowhere").symlink_to("gone")
    (folder / "empty").mkdir()
    (folder / "broken").mkdir()
    (folder / "broken/bad.mp4").write_bytes(b"nothing like a video" * 20)
    (folder / "hole.txt").write_text("****\n*   \n****\n")
    (folder / "ring.txt").write_text("*****\n*   *\n* * *\n*   *\n*****\n")
    source = bundled_policies("walker-walk", "expert")[0]
    shutil.copy(source, folder / "walker.safetensors")
    shutil.copy(bundled_policies("ant-maze-medium7x7a", "expert")[0], folder / "maze.safetensors")
    (folder / "truncated.safetensors").write_bytes(source.read_bytes()[:5000])
    (folder / "nan.safetensors").write_bytes(source.read_bytes()[:-4] + np.float32("nan").tobytes())
    return folder


@pytest.mark.parametrize("words, cure", [(f"rollout {words} --out new", cure) for words, cure in ROLLOUTS] + OTHERS)
def test_a_mistake_is_answered_in_a_line_with_the_cure_and_nothing_is_written(place, monkeypatch, words, cure):
    monkeypatch.setenv("DMCVB_GEN_DISTRACTORS", "")
    monkeypatch.chdir(place)
    before = sorted(place.iterdir())
    said = invoke(*words.split(), code=2).output
    assert cure in said and said.startswith("error: ") and said.count("\n") == 1, said
    assert sorted(place.iterdir()) == before


@pytest.mark.parametrize("pair", ["endpoint", "=x", "secret=x", "aws_session_token=x"])
def test_options_of_a_store_are_pairs_and_no_secrets(pair):
    with pytest.raises(Exception, match="NAME=VALUE|in the environment"):
        parse_options(None, None, [pair])


TWINS = [TINY_MAZE.replace("tiny", "twin"), "ant-maze-twin:*****/*...*/*****"]
PYTHON = [
    (lambda out: dmcvb_gen.rollout("walker-walk", episodes=0, out=out), "^episodes is 0: input should be"),
    (lambda out: dmcvb_gen.rollout("walker-walk", size="large", out=out), "^size is 'large': input"),
    (lambda out: dmcvb_gen.rollout("walker-walk", episode_range="0:1", out=out), "^episode_range is '0:1': input"),
    (lambda out: dmcvb_gen.rollout("walker-walk", workers=-3, out=out), "^workers is -3: input should be greater"),
    (lambda out: dmcvb_gen.rollout(None, out=out), "^tasks is None"),
    (lambda out: dmcvb_gen.rollout("", out=out), "^tasks is empty"),
    (lambda out: dmcvb_gen.rollout("walker-walk", behaviour="", out=out), "behaviour is empty; give a value, or leave"),
    (lambda out: dmcvb_gen.rollout("walker-walk", out=""), "^out is empty; give a value"),
    (lambda out: dmcvb_gen.rollout("walker-walk", max_steps=9999, out=out), "^max_steps is 9999: Input"),
    (lambda out: dmcvb_gen.rollout(TWINS, levels="random", out=out), "two mazes are called ant-maze-twin; rename"),
    (lambda out: dmcvb_gen.paint(out, views=[]), "views names no view"),
    (lambda out: dmcvb_gen.regenerate(manifest="quickstart"), "out=FOLDER"),
    (lambda out: dmcvb_gen.verify(out, everything=True), "always read whole"),
    (lambda out: dmcvb_gen.fetch("file:publ", out, episode_range=(2, 2)), "with 0 <= A < B"),
    (lambda out: dmcvb_gen.export(out, "hdf5", out / "x"), "no release"),
    (lambda out: dmcvb_gen.validate(out, checks_only=True, agents="bc"), ": checks_only trains nothing"),
    (lambda out: dmcvb_gen.validate(out, scale=float("inf")), "^scale is inf: input should be "),
    (lambda out: dmcvb_gen.repaint(out, out=None), "^out is None: input should be"),
]


@pytest.mark.parametrize("call, message", PYTHON)
def test_functions_refuse_what_their_commands_do_and_name_parameters(call, message, tmp_path):
    with pytest.raises(DmcvbError, match=message) as caught:
        call(tmp_path / "out")
    assert " --" not in re.sub("`[^`]*`|dmcvb-gen [^;,]*", "", f" {caught.value}"), "a flag, which Python has not"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("message, named", [
    ("choose another --out, or fewer --episodes", "choose another out, or fewer episodes"),
    ("select with --only and --range", "select with only and episode_range"),
    ("see `info --json`; add --checks-only", "see `info --json`; add checks_only"),
    ("run dmcvb-gen fetch URL --out FOLDER; or leave --paint", "run dmcvb-gen fetch URL --out FOLDER; or leave paint"),
])  # fmt: skip
def test_messages_of_functions_name_parameters(message, named):
    assert with_parameters(message) == named


def test_a_disk_that_cannot_hold_the_release_is_told_before_any_work(tmp_path, monkeypatch):
    """20 episodes of 61 images take 20 x 61 x 16 x 16 x 3 bytes and more before compression."""
    words = "walker-walk --level random --episodes 20 --max-steps 60 --size 16 --out".split()
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=LEAST_SHARE * 20 * 61 * 16 * 16 * 3))
    said = invoke("rollout", *words, tmp_path / "r", code=2).output
    assert re.match(r"error: at least .*B are needed and .*B are free at .*; make room", said), said
    assert not (tmp_path / "r").exists()
