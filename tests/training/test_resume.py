"""Runs that were stopped, killed or out of disk go on as if nothing had happened."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import io
import json
import multiprocessing
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.policy_file import load_policy, read_header
from dmcvb_gen.state_file import STATE, pack_state, read_state_file
from dmcvb_gen.training import run as runs
from dmcvb_gen.training.behaviour import train_behaviour
from dmcvb_gen.training.run import Run, RunConfig, Stopped, open_run
from dmcvb_gen.training.run_log import COLUMNS, read_rows
from dmcvb_gen.training.sac import ReplayBuffer


@pytest.fixture(autouse=True)
def one_thread():
    """As many threads as in the processes that are killed: sums of several differ in their last bits."""
    torch.set_num_threads(1)


TINY = {
    "sac": dict(warmup_steps=24, batch_size=16, actor_hidden=[16], critic_hidden=[16], compile=False, simulations=4),
    "guided": dict(batch_size=16, simulations=4, train_episode_steps=20, half_life=100, layers=2),
}
TINY["mpo"] = TINY["sac"] | dict(train_episode_steps=20, target_period=7)
TINY["sac"] |= dict(train_episode_steps=20, bfloat16=False)


@pytest.fixture(autouse=True)
def quick_evaluations(monkeypatch):
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 2)


def config(algorithm="sac", steps=160, every=40, **changes):
    task = "ant-maze-easy7x7a" if algorithm == "guided" else "cheetah-run"
    fields = dict(task=task, algorithm=algorithm, steps=steps, seed=0, settings=TINY[algorithm])
    return RunConfig(**fields | dict(evaluate_every=every) | changes)


def train(folder, resume=False, **changes):
    run = open_run(folder, config(**changes), resume)
    run.train()
    return run


def leaves(value, name=""):
    """Every number, text and tensor of a nested state by its place."""
    if isinstance(value, dict):
        return {place: leaf for key, part in value.items() for place, leaf in leaves(part, f"{name}/{key}").items()}
    if isinstance(value, list | tuple):
        return leaves(dict(enumerate(value)), name)
    return {name: value}


def assert_same_run(first, second):
    """All but the seconds is equal to the bit: learner, random states, simulations, policies, curve, replay."""
    ours, theirs = leaves(first.saved()), leaves(second.saved())
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - {"/seconds"}:
        if isinstance(ours[name], torch.Tensor):
            torch.testing.assert_close(ours[name], theirs[name], rtol=0, atol=0, equal_nan=True)
        else:
            assert ours[name] == theirs[name], name
    found = [
        {path.name: load_policy(path) for path in (run.folder / "checkpoints").iterdir()} for run in (first, second)
    ]
    one, other = ({name: policy for name, policy in all.items() if policy.header.evaluation} for all in found)
    assert one.keys() == other.keys() and one
    for name, policy in one.items():
        assert policy.header.evaluation == other[name].header.evaluation
        assert all(np.array_equal(value, other[name].weights[key]) for key, value in policy.weights.items())
    curves = [[row | {"seconds": ""} for row in read_rows(run.folder)] for run in (first, second)]
    assert curves[0] == curves[1]


@pytest.mark.slow_cases("guided", "mpo", "sac")
@pytest.mark.parametrize("algorithm", TINY)
def test_a_stopped_and_resumed_run_is_an_uninterrupted_one_to_the_bit(tmp_path, algorithm):
    fields = dict(algorithm=algorithm, every=80 if algorithm == "guided" else 40)  # mazes: long evaluations
    whole = train(tmp_path / "whole", **fields)
    train(tmp_path / "parts", **fields, steps=80)
    np.random.seed(99), torch.manual_seed(99)  # nothing may come from what this process did before
    assert_same_run(whole, train(tmp_path / "parts", True, **fields))


def test_what_is_learned_does_not_depend_on_how_often_it_is_evaluated(tmp_path):
    often, once = (train(tmp_path / str(every), every=every) for every in (40, 1000))
    names = [sorted(int(path.stem) for path in (run.folder / "checkpoints").iterdir()) for run in (often, once)]
    assert names == [[40, 80, 120, 160], [160]]  # the last step always has one
    one, other = (load_policy(run.folder / "checkpoints" / "0000000160.safetensors") for run in (often, once))
    assert all(np.array_equal(value, other.weights[key]) for key, value in one.weights.items())


@pytest.mark.slow
def test_observed_touch_of_an_ant_survives_the_interruption(tmp_path):
    """Touch sensors do not follow from the physics state alone."""
    fields = dict(task="ant-maze-empty7x7", settings=TINY["sac"] | {"train_episode_steps": 100}, every=1000)
    whole = train(tmp_path / "whole", **fields)
    train(tmp_path / "parts", **fields, steps=80)
    parts = train(tmp_path / "parts", True, **fields)
    rows = [run.saved()["buffer"]["rows"] for run in (whole, parts)]
    assert all(torch.equal(rows[0][name], rows[1][name]) for name in ("observation", "next_observation", "reward"))


SCRIPT = """
import json, sys, torch
from dmcvb_gen.training import run as runs
torch.set_num_threads(1)
runs.EVALUATION_EPISODES = 2
runs.SAVE_SECONDS = 0  # save at every moment at which a run may be stopped
runs.open_run(sys.argv[1], runs.RunConfig(**json.loads(sys.argv[2])), True).train()
"""


@pytest.mark.slow_cases("sac")
@pytest.mark.parametrize("algorithm", ["sac", "guided"])
def test_a_killed_run_resumes_to_the_same_bits(tmp_path, algorithm):
    fields = json.dumps(vars(config(algorithm, steps=100_000)))
    process = subprocess.Popen([sys.executable, "-W", "ignore", "-c", SCRIPT, str(tmp_path / "killed"), fields])
    deadline = time.time() + 120
    while len(list((tmp_path / "killed").glob("checkpoints/0*"))) < 3 and time.time() < deadline:
        assert process.poll() is None, "the run ended by itself"
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    # What the kill may leave: a log line half written, files half written, a checkpoint newer than the saved state.
    with (tmp_path / "killed" / "progress.csv").open("a") as file:
        file.write("99")
    (tmp_path / "killed" / "resume" / "state.partial").write_bytes(b"half")
    (tmp_path / "killed" / "checkpoints" / ".0000000999.safetensors.partial").write_bytes(b"half")
    run = open_run(tmp_path / "killed", config(algorithm, steps=100_000), True)
    steps = (run.saved()["step"] // 40 + 2) * 40
    killed = train(tmp_path / "killed", True, algorithm=algorithm, steps=steps)
    assert_same_run(train(tmp_path / "whole", algorithm=algorithm, steps=steps), killed)


def _train_in_a_process(folder, fields, signals=()):
    """Train in a forked process, saving whenever it may, and send it signals: (seconds to wait, number)."""
    process = multiprocessing.get_context("fork").Process(target=_train_saving_often, args=(folder, fields))
    process.start()
    for wait, number in signals:
        process.join(wait)
        if process.is_alive():
            os.kill(process.pid, number)
    process.join(120)
    assert not process.is_alive()
    return process.exitcode


def _train_saving_often(folder, fields):
    runs.SAVE_SECONDS = 0
    train(folder, True, **fields)
    os._exit(0)


LONG = {
    "sac": dict(steps=1200, every=400),
    "guided": dict(steps=200, every=200),
}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", LONG)
def test_ten_kills_at_random_moments_change_nothing(tmp_path, algorithm):
    fields = dict(algorithm=algorithm) | LONG[algorithm]
    whole, chance, kills = train(tmp_path / "whole", **fields), np.random.default_rng(0), 0
    for _ in range(10):
        code = _train_in_a_process(tmp_path / "killed", fields, [(chance.uniform(0.05, 0.6), signal.SIGKILL)])
        kills += code == -signal.SIGKILL
    assert kills >= 2
    killed = train(tmp_path / "killed", True, **fields)
    assert killed.step == whole.step == fields["steps"]
    assert_same_run(whole, killed)


@pytest.mark.parametrize(
    ("algorithm", "number"),
    [("sac", signal.SIGINT), pytest.param("guided", signal.SIGTERM, marks=pytest.mark.slow)],
)
def test_a_signal_saves_the_run_and_a_second_one_does_not_hurt(tmp_path, algorithm, number, monkeypatch):
    monkeypatch.setattr(runs, "SAVE_SECONDS", 3600)
    fields = dict(algorithm=algorithm, steps=80, every=80)
    whole, run = train(tmp_path / "whole", **fields), open_run(tmp_path / "run", config(**fields), False)
    told, handler, pack = [], signal.getsignal(number), runs.pack_state

    def tick(steps):
        if run.step == 40:
            os.kill(os.getpid(), number)

    def pack_and_signal(state):
        os.kill(os.getpid(), number)
        return pack(state)

    monkeypatch.setattr(runs, "pack_state", pack_and_signal)
    with pytest.raises(Stopped, match="step 40, and saved; resume: .* --resume; --behaviour .*@latest takes"):
        run.train(tick=tick, stopping=lambda: told.append(1))
    assert told == [1] and signal.getsignal(number) is handler
    [latest] = resolve_policies(run.task.id, "expert", f"{run.folder}@latest")
    assert read_header(latest).agent_step == 40
    monkeypatch.setattr(runs, "pack_state", pack)
    assert run.saved()["step"] == 40
    assert_same_run(whole, train(tmp_path / "run", True, **fields))


@contextlib.contextmanager
def largest_file(size):
    """No file grows beyond `size` bytes, as on a full disk: the write fails with an OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.slow_cases("sac")
@pytest.mark.parametrize("algorithm", ["sac", "mpo"])
def test_a_disk_that_fills_up_while_saving_leaves_the_previous_state(tmp_path, algorithm):
    run = train(tmp_path / "run", algorithm=algorithm, steps=80)
    path = tmp_path / "run" / "resume" / STATE
    before = path.read_bytes()
    checkpoints = sorted((tmp_path / "run" / "checkpoints").iterdir())
    with largest_file(len(before) - 1000), pytest.raises(DmcvbError, match="previous saved state is whole.*--resume"):
        train(tmp_path / "run", True, algorithm=algorithm)
    assert path.read_bytes() == before and not list((tmp_path / "run").rglob("*.partial"))
    assert set(checkpoints) <= set((tmp_path / "run" / "checkpoints").iterdir())
    whole = train(tmp_path / "whole", algorithm=algorithm)
    assert_same_run(whole, train(tmp_path / "run", True, algorithm=algorithm))
    assert run.step == 80


def test_a_disk_that_fills_up_while_a_checkpoint_is_written_leaves_no_half_of_it(tmp_path):
    train(tmp_path / "run", steps=80)
    with largest_file(2000), pytest.raises(DmcvbError, match="previous saved state is whole"):
        train(tmp_path / "run", True)
    assert [read_header(path).agent_step for path in sorted((tmp_path / "run" / "checkpoints").iterdir())] == [40, 80]


def filled(size, rounds, old=None):
    """A ring of one simulation whose row i holds i, after so many rounds."""
    buffer = ReplayBuffer(size, 1, 1, 1)
    if old:
        buffer.load_state(old.state())
    for value in range(rounds[0], rounds[1]):
        row = np.full((1, 1), value, np.float32)
        buffer.add(observation=row, next_observation=row, action=row, reward=row[0], terminated=[0], ended=[0])
    return buffer


@pytest.mark.parametrize("rounds", [4, 6, 9, 14])
def test_a_run_that_is_made_longer_keeps_its_replay_buffer_in_order(rounds):
    longer = filled(20, (rounds, rounds + 3), filled(6, (0, rounds)))
    kept = range(max(rounds - 6, 0), rounds + 3)
    assert len(longer) == len(kept) and longer.arrays["reward"][: len(kept)].tolist() == list(kept)
    batch = longer.sample_steps(np.random.default_rng(0), 60, 3, 1.0)
    led = dict(zip(batch["observation"][:, 0].tolist(), batch["next_observation"][:, 0].tolist(), strict=True))
    assert all(end == min(start + 2, rounds + 2) for start, end in led.items())
    same = filled(6, (0, 0), filled(6, (0, rounds)))
    assert same.arrays["reward"].tolist() == filled(6, (0, rounds)).arrays["reward"].tolist()


@pytest.mark.slow_cases("guided")
@pytest.mark.parametrize("algorithm", ["sac", "guided"])
def test_a_run_whose_saved_state_is_gone_keeps_its_checkpoints(tmp_path, algorithm, monkeypatch):
    train(tmp_path / "run", algorithm=algorithm)
    kept = sorted((tmp_path / "run" / "checkpoints").iterdir())
    shutil.rmtree(tmp_path / "run" / "resume")
    monkeypatch.setattr(runs, "SAVE_SECONDS", 0)
    with pytest.raises(DmcvbError, match="has checkpoints, but nothing to resume from.*choose another --out"):
        train(tmp_path / "run", resume=True, algorithm=algorithm, steps=240)
    assert sorted((tmp_path / "run" / "checkpoints").iterdir()) == kept != []


@pytest.mark.slow
def test_a_run_goes_on_when_what_it_started_from_is_gone(tmp_path):
    train(tmp_path / "first")
    source = {"init_from": str(tmp_path / "first")}
    train(tmp_path / "run", **source)
    shutil.rmtree(tmp_path / "first")
    assert train(tmp_path / "run", resume=True, steps=240, **source).step == 240
    with pytest.raises(DmcvbError, match="neither a run folder nor a policy file"):
        train(tmp_path / "other", **source)


def test_two_processes_do_not_train_in_one_folder(tmp_path):
    run = open_run(tmp_path / "run", config(), False)
    (tmp_path / "run" / "resume").mkdir()
    with (tmp_path / "run" / "resume" / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(DmcvbError, match="another process"):
            run.train()
        before = (tmp_path / "run" / "run.json").read_bytes()
        with pytest.raises(DmcvbError, match="another process"):
            open_run(tmp_path / "run", config(steps=200), True).train()
        assert (tmp_path / "run" / "run.json").read_bytes() == before  # it says what the other one trains


def test_a_run_looks_again_when_it_is_alone(tmp_path):
    late = open_run(tmp_path / "run", config(), False)
    (tmp_path / "run" / "run.json").unlink()
    train(tmp_path / "run", seed=1)
    with pytest.raises(DmcvbError, match="with seed 1, asked for 0"):
        late.train()


@pytest.mark.slow_cases("90-mpo", "90-sac", "None-sac")
@pytest.mark.parametrize("algorithm", ["sac", "mpo"])
@pytest.mark.parametrize("steps", [None, 90])
def test_a_finished_run_that_went_a_few_steps_too_far_resumes_to_what_it_is(algorithm, steps, tmp_path):
    end = train(tmp_path / "run", algorithm=algorithm, steps=90).step
    assert end > 90, "steps that the simulations share evenly"
    before = {path.name: path.read_bytes() for path in (tmp_path / "run" / "checkpoints").iterdir()}
    again = train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, steps=steps, progress=False)
    assert again.steps == end
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "run" / "checkpoints").iterdir()}


def test_training_leaves_the_callers_threads_and_figures_alone(tmp_path):
    import matplotlib

    before, backend = torch.get_num_threads(), matplotlib.get_backend()
    torch.set_num_threads(2)
    matplotlib.use("svg")
    try:
        train(tmp_path / "run", steps=80)
        train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, progress=False)
        assert torch.get_num_threads() == 2 and matplotlib.get_backend() == "svg"
    finally:
        torch.set_num_threads(before)
        matplotlib.use(backend)


def test_a_run_that_is_made_shorter_says_so(tmp_path):
    train(tmp_path / "run", steps=80)
    said = []
    train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, steps=160, progress=False, notify=said.append)
    with pytest.raises(DmcvbError, match="at step 160, past --steps 120"):
        train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, steps=120, progress=False)
    assert not any("ends at" in line for line in said)
    path = tmp_path / "run" / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"steps": 400}))
    train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, steps=200, progress=False, notify=said.append)
    assert "The run ends at step 200 now, not at 400." in said


def test_the_command_of_a_maze_with_a_reward_of_its_own_names_all_of_it(tmp_path):
    """A layout's file says nothing of the reward."""
    task = "ant-maze-hall:****/*..*/****"
    for name, words in ((task, "--layout"), (f"{task}@geodesic", f"'{task}@geodesic'")):
        (tmp_path / "run").mkdir(exist_ok=True)
        command = Run(tmp_path / "run", config(task=name)).resume_command()
        assert words in command and shlex.split(command)[2] in ("--layout", name)


@pytest.mark.slow
def test_a_run_of_which_nothing_is_saved_yet_begins_at_step_0_and_says_so(tmp_path):
    whole, again = (train(tmp_path / name, steps=80) for name in ("whole", "run"))
    for rest in ("resume", "checkpoints"):  # as a run that was killed before it saved anything
        shutil.rmtree(tmp_path / "run" / rest)
    (tmp_path / "run/progress.csv").unlink()
    said: list[str] = []
    train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, progress=False, notify=said.append)
    assert any("so the run begins at step 0" in line for line in said)
    assert_same_run(whole, again)


def test_a_saved_state_that_holds_code_or_rubbish_is_refused(tmp_path):
    run = open_run(tmp_path / "run", config(), False)
    (tmp_path / "run" / "resume").mkdir()
    path = tmp_path / "run" / "resume" / STATE
    whole = pack_state({"step": 0, "seconds": 0.0})
    pickled = io.BytesIO()
    torch.save(print, pickled)
    for content in (pickled.getvalue(), b"rubbish", whole[:-3], whole.replace(b"dict", b"dice"), b""):
        path.write_bytes(content)
        with pytest.raises(DmcvbError, match="cannot be read"):
            run.train()


def test_a_state_comes_back_as_it_was(tmp_path):
    shared = torch.arange(6.0)
    state = {"step": 3, "betas": (0.9, 0.999), "state": {0: {"exp": shared[::2]}, 1: {"exp": shared}}, "none": None}
    state |= {"rng": torch.get_rng_state(), "full": True, "empty": torch.zeros(0, 2), "list": [1, {"a": "b"}], "d": {}}
    (tmp_path / STATE).write_bytes(pack_state(state))
    back = read_state_file(tmp_path / STATE, "")
    assert repr(back) == repr(state) and torch.equal(back["rng"], state["rng"])
    with pytest.raises(TypeError, match="cannot hold"):
        pack_state({"code": print})


def test_csv_and_tensorboard_tell_the_same(tmp_path):
    run = train(tmp_path / "run", steps=80)
    rows = read_rows(run.folder)
    assert [row["step"] for row in rows] == ["40", "80"] and tuple(rows[0]) == COLUMNS
    with (run.folder / "progress.csv").open() as file:
        assert list(csv.DictReader(file)) == rows
    events = EventAccumulator(str(run.folder / "tensorboard"))
    events.Reload()
    assert {"training/critic_loss", "training/entropy", "evaluation/return_std"} <= set(events.Tags()["scalars"])
    for row, event in zip(rows, events.Scalars("evaluation/return_mean"), strict=True):
        assert event.step == int(row["step"]) and event.value == pytest.approx(float(row["return_mean"]), rel=1e-5)
        policy = read_header(run.folder / "checkpoints" / f"{event.step:010d}.safetensors")
        assert policy.evaluation.mean == pytest.approx(event.value, rel=1e-5)
