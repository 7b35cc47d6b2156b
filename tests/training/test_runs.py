"""Runs of every algorithm: what a folder holds, and that runs that were stopped, killed or out of disk go on."""

import fcntl
import io
import multiprocessing
import os
import pathlib
import random
import shutil
import signal

import numpy as np
import pytest
import torch

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies.bundled import bundled_policies, resolve_policies
from dmcvb_gen.policies.policy_file import load_policy, read_header, save_policy
from dmcvb_gen.state_file import STATE, pack_state, read_state_file
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import run as runs
from dmcvb_gen.training.behaviour import run_config, train_behaviour
from dmcvb_gen.training.episodes import standing_states
from dmcvb_gen.training.networks import Actor, as_arrays
from dmcvb_gen.training.run import LOG, Run, RunConfig, Stopped, check_same, open_run, read_rows, start_from
from dmcvb_gen.training.sac import Sac
from dmcvb_gen.training.settings import default_run
from tests.faults.inject import files_up_to

SAC = dict(warmup_steps=24, batch_size=16, actor_hidden=[16], critic_hidden=[16], compile=False, simulations=4)
SAC |= dict(train_episode_steps=20)
AIDS = dict(greedy_fraction=0.5, low_spawn_fraction=1.0, shaping=1.0, path_reward_scale=1.0)
CASES = {
    "sac": ("cheetah-run", "sac", SAC),
    "mpo": ("cheetah-run", "mpo", SAC | dict(target_period=7)),
    "maze": ("ant-maze-empty7x7", "sac", SAC | AIDS),
    "guided": ("ant-maze-easy7x7a", "guided", dict(batch_size=16, simulations=4, half_life=100, layers=2)),
    "sb3": ("cheetah-run", "sb3:SAC", dict(learning_starts=24, batch_size=16, simulations=4)),
}
"""Task, algorithm and settings. An ant's touch sensors do not follow from its physics."""
OURS = ("sac", "mpo", "maze", "guided")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Two episodes an evaluation, and one thread as in processes that are killed: sums of several differ."""
    torch.set_num_threads(1)
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 2)
    monkeypatch.setattr("dmcvb_gen.training.guided.TIMES_MORE_EPISODES", 1)


def config(case="sac", steps=160, every=80, **changes):
    task, algorithm, settings = CASES[case]
    fields = dict(task=task, algorithm=algorithm, steps=steps, seed=0, settings=settings, evaluate_every=every)
    return RunConfig(**fields | changes)


def train(folder, resume=False, **changes):
    run = open_run(folder, config(**changes), resume)
    run.train()
    return run


def names(run):
    return sorted(int(path.stem) for path in (run.folder / "checkpoints").iterdir())


def assert_same_run(first, second):
    """All but the seconds is equal to the bit: learner, random states, simulations, policies, curve, replay."""
    ours, theirs = (pack_state(run.saved() | {"seconds": 0.0}) for run in (first, second))
    same = ours == theirs  # so that pytest shows no megabytes
    assert same
    folders = [run.folder / "checkpoints" for run in (first, second)]
    found = [{path.name: load_policy(path) for path in folder.iterdir()} for folder in folders]
    one, other = ({name: policy for name, policy in all.items() if policy.header.evaluation} for all in found)
    assert one.keys() == other.keys() and one
    for name, policy in one.items():
        assert policy.header.evaluation == other[name].header.evaluation
        assert all(np.array_equal(value, other[name].weights[key]) for key, value in policy.weights.items())
    curves = [[row | {"seconds": ""} for row in read_rows(run.folder)] for run in (first, second)]
    assert curves[0] == curves[1]


def assert_policies_say_what_they_are_and_the_log_tells_the_same(run, case):
    task, algorithm, _ = CASES[case]
    rows = read_rows(run.folder)
    assert [row["step"] for row in rows] == [80, 160] and rows[1]["seconds"] >= rows[0]["seconds"]
    for row in rows:
        header = load_policy(run.folder / "checkpoints" / f"{row['step']:010d}.safetensors", get_task(task)).header
        assert header.evaluation.mean == row["return_mean"] and header.agent_step == row["step"]
        assert header.algorithm == algorithm
        assert header.command.startswith(f"dmcvb-gen train-behaviour {task} --algo {algorithm} --steps 160 --seed 0")


@pytest.mark.slow_cases("maze", "guided", "mpo", "sb3")
@pytest.mark.parametrize("case", CASES)
def test_a_signal_saves_a_run_that_goes_on_to_the_same_bits_and_a_second_one_does_not_hurt(case, tmp_path, monkeypatch):
    number = signal.SIGTERM if case == "guided" else signal.SIGINT
    run = open_run(tmp_path / "run", config(case), False)
    told, handler, pack = [], signal.getsignal(number), runs.pack_state

    def tick(steps):
        if run.step == 40:
            os.kill(os.getpid(), number)

    def pack_and_signal(state):
        if run.step:
            os.kill(os.getpid(), number)
        return pack(state)

    monkeypatch.setattr(runs, "pack_state", pack_and_signal)
    with pytest.raises(Stopped, match="step 40, and saved; resume: .* --resume; --behaviour .*@latest takes"):
        run.train(tick=tick, stopping=lambda: told.append(1))
    assert told == [1] and signal.getsignal(number) is handler
    [latest] = resolve_policies(run.task.id, "expert", f"{run.folder}@latest")
    assert read_header(latest).agent_step == 40 and read_header(latest).evaluation is None
    monkeypatch.setattr(runs, "pack_state", pack)
    assert run.saved()["step"] == 40
    np.random.seed(99), torch.manual_seed(99)  # nothing may come from what this process did before
    resumed = train(tmp_path / "run", True, case=case)
    assert names(resumed) == [40, 80, 160]
    assert_policies_say_what_they_are_and_the_log_tells_the_same(resumed, case)
    if case in OURS:
        assert_same_run(train(tmp_path / "whole", case=case), resumed)


@pytest.mark.slow
def test_what_is_learned_does_not_depend_on_how_often_it_is_evaluated(tmp_path):
    often, once = (train(tmp_path / str(every), every=every) for every in (40, 1000))
    assert (names(often), names(once)) == ([40, 80, 120, 160], [160])  # the last step always has one
    one, other = (load_policy(run.folder / "checkpoints" / "0000000160.safetensors") for run in (often, once))
    assert all(np.array_equal(value, other.weights[key]) for key, value in one.weights.items())


def _train_saving_often(folder, fields):
    runs.SAVE_SECONDS = 0
    train(folder, True, **fields)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "steps", "every"), [("sac", 1200, 400), ("guided", 200, 200)])
def test_ten_kills_at_random_moments_change_nothing(tmp_path, case, steps, every):
    fields = dict(case=case, steps=steps, every=every)
    whole, chance, kills = train(tmp_path / "whole", **fields), np.random.default_rng(0), 0
    for _ in range(10):
        arguments = (tmp_path / "killed", fields)
        process = multiprocessing.get_context("fork").Process(target=_train_saving_often, args=arguments)
        process.start()
        process.join(chance.uniform(0.05, 0.6))
        process.kill()
        process.join()
        kills += process.exitcode == -signal.SIGKILL
    assert kills >= 2
    with (tmp_path / "killed" / LOG).open("a") as file:
        file.write('{"step": 99')  # a line half written
    (tmp_path / "killed" / "resume" / ".state.safetensors.x.partial").write_bytes(b"half")
    killed = train(tmp_path / "killed", True, **fields)
    assert killed.step == whole.step == steps and not list((tmp_path / "killed").rglob("*.partial"))
    assert_same_run(whole, killed)


@pytest.mark.slow
def test_a_disk_that_fills_up_while_saving_leaves_the_previous_state(tmp_path):
    train(tmp_path / "run", steps=80)
    path = tmp_path / "run" / "resume" / STATE
    before = path.read_bytes()
    with files_up_to(len(before) - 1000), pytest.raises(DmcvbError, match="previous saved state is whole.*--resume"):
        train(tmp_path / "run", True)
    assert path.read_bytes() == before and not list((tmp_path / "run").rglob("*.partial"))
    assert_same_run(train(tmp_path / "whole"), train(tmp_path / "run", True))


def test_checkpoints_whose_saved_state_is_gone_are_not_written_over(tmp_path):
    kept = names(train(tmp_path / "run"))
    shutil.rmtree(tmp_path / "run" / "resume")
    with pytest.raises(DmcvbError, match="has checkpoints, but nothing to resume from.*choose another --out"):
        train(tmp_path / "run", True, steps=240)
    assert names(open_run(tmp_path / "run", config(), True)) == kept != []


@pytest.mark.slow_cases("guided")
@pytest.mark.parametrize("case", ["sac", "guided"])
def test_a_run_goes_on_when_what_it_started_from_is_gone(case, tmp_path):
    if case == "sac":
        first = train(tmp_path / "first", steps=80)
        source, fresh = first.folder, Sac(first.header, first.settings, 1)
        start_from(fresh, open_run(tmp_path / "x", config(init_from=str(source)), False))
        known = first.saved()["learner"]["returns"]  # critics know rewards on this scale
        assert fresh.returns.state()["norm"]["count"] == known["norm"]["count"] > 1
    else:
        source = shutil.copy(bundled_policies("ant-maze-empty7x7", "expert")[0], tmp_path / "guide.safetensors")
    given = dict(case=case, init_from=str(source))
    train(tmp_path / "run", steps=40, **given)
    os.rename(source, tmp_path / "elsewhere")
    assert train(tmp_path / "run", True, steps=80, **given).step == 80
    with pytest.raises(DmcvbError, match="neither a run folder nor a policy file"):
        train(tmp_path / "other", **given)


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


def test_a_finished_run_that_went_a_few_steps_too_far_resumes_to_what_it_is(tmp_path):
    end = train(tmp_path / "run", steps=90).step
    assert end > 90, "steps that the simulations share evenly"
    before = {path.name: path.read_bytes() for path in (tmp_path / "run" / "checkpoints").iterdir()}
    for steps in (None, 90):
        again = train_behaviour(out=tmp_path / "run", resume=True, steps=steps, progress=False)
        assert again.steps == end
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "run" / "checkpoints").iterdir()}
    with pytest.raises(DmcvbError, match="at step 92, past steps 60; give more"):
        train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, steps=60, progress=False)
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    with pytest.raises(DmcvbError, match="holds no evaluated checkpoints; give a run folder"):
        train_behaviour(out=tmp_path / "run", resume=True, progress=False)


def test_training_leaves_the_callers_threads_figures_and_generators_alone(tmp_path):
    import matplotlib

    before, backend = torch.get_num_threads(), matplotlib.get_backend()
    torch.set_num_threads(2)
    matplotlib.use("svg")
    try:
        train(tmp_path / "run", steps=80)
        generators = torch.get_rng_state(), random.getstate(), np.random.get_state()[1].copy()
        train_behaviour("cheetah-run", out=tmp_path / "run", resume=True, steps=100, progress=False)
        assert torch.equal(torch.get_rng_state(), generators[0]) and random.getstate() == generators[1]
        assert np.array_equal(np.random.get_state()[1], generators[2])
        assert torch.get_num_threads() == 2 and matplotlib.get_backend() == "svg"
    finally:
        torch.set_num_threads(before)
        matplotlib.use(backend)


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


def test_a_run_folder_is_not_mixed_up(tmp_path):
    open_run(tmp_path / "run", config(), False)
    with pytest.raises(DmcvbError, match="--resume"):
        open_run(tmp_path / "run", config(), False)
    with pytest.raises(DmcvbError, match="with seed 0, asked for 1"):
        open_run(tmp_path / "run", config(seed=1), True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x").touch()
    with pytest.raises(DmcvbError, match="holds no run"):
        open_run(tmp_path / "other", config(), True)


def test_a_resumed_run_keeps_what_is_not_given_and_refuses_what_differs():
    found = config(seed=4, settings={"batch_size": 16})
    assert run_config("cheetah-run", "sac", {}, found) == found
    longer = run_config("cheetah-run", "sac", {"discount": 0.99}, found, steps=500, seed=None)
    check_same("runs/x", found, longer)  # naming a default is no difference
    assert longer.steps == 500
    for changed, words in (
        (run_config("cheetah-run", "sac", {"discount": 0.9}, found), "discount 0.99, asked for 0.9"),
        (run_config("walker-walk", "sac", {}, found), "task 'cheetah-run', asked for 'walker-walk'"),
        (run_config("cheetah-run", "mpo", {}, found), "algorithm 'sac', asked for 'mpo'"),
    ):
        with pytest.raises(DmcvbError, match=f"holds a run with {words}"):
            check_same("runs/x", found, changed)


def saved_actor(path, seed=0, **changes):
    """A policy file with random weights of the actor of `config()`."""
    header = Run(path.parent, config()).header.model_copy(update=changes)
    torch.manual_seed(seed)
    save_policy(path, header, as_arrays(Actor(header).state_dict()))
    return str(path)


def test_a_policy_says_what_it_started_from_but_not_where_that_lay(tmp_path):
    (tmp_path / "home of somebody").mkdir()
    source = saved_actor(tmp_path / "home of somebody" / "own.safetensors")
    run = train(tmp_path / "run", init_from=source, steps=40)
    header, digest = run.header, sha256_file(source)
    assert header.training["init_from"] == "own.safetensors" and header.training["init_sha256"] == digest
    assert "--init-from own.safetensors" in header.command and "home of somebody" not in header.model_dump_json()
    os.unlink(source)  # a run that goes on does not read it again
    saved_actor(pathlib.Path(source), seed=1)
    assert open_run(tmp_path / "run", config(init_from=source, steps=40), True).header == header
    folder = open_run(tmp_path / "second", config(init_from=f"{tmp_path / 'run'}/"), False).header
    assert folder.training["init_from"] == "run" and "init_sha256" not in folder.training
    assert "--init-from run " in folder.command


def test_a_run_begins_with_the_actor_of_the_policy_or_the_networks_of_the_run_that_it_starts_from(tmp_path):
    policy = saved_actor(tmp_path / "own.safetensors", seed=3)
    first = train(tmp_path / "first", init_from=policy, steps=4, settings=SAC | {"warmup_steps": 3})
    weights = load_policy(policy).weights
    networks = first.saved()["learner"]["networks"]
    np.testing.assert_allclose(networks["actor.mean.weight"].numpy(), weights["mean.weight"], atol=0.01)
    second = train(tmp_path / "second", init_from=str(first.folder), steps=4, settings=SAC | {"warmup_steps": 3})
    begun = second.saved()["learner"]["networks"]["critic.head"]
    torch.testing.assert_close(begun, networks["critic.head"], atol=0.05, rtol=0)


MISFITS = [
    ({"hidden": (24,)}, r"size mismatch for body\.0\.weight"),
    ({"activation": "tanh"}, "activation tanh, expected relu"),
    ({"distribution": "gaussian"}, "Unexpected key"),
]


@pytest.mark.parametrize("changes, words", MISFITS)
def test_a_policy_that_does_not_fit_begins_no_run(tmp_path, changes, words):
    source = saved_actor(tmp_path / "other.safetensors", **changes)
    with pytest.raises(DmcvbError, match=f"its networks do not fit these settings and task .*{words}"):
        open_run(tmp_path / "run", config(init_from=source), False)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow_cases("maze-4-20")
@pytest.mark.parametrize(("case", "share", "most"), [("sac", 8, 20), ("maze", 4, 20), ("guided", 40, 60)])
def test_evaluations_keep_to_their_share_of_the_steps_however_often_they_are(tmp_path, monkeypatch, case, share, most):
    """Counted from outside: agent steps that evaluations were asked to simulate, for those that were trained."""
    asked, known = [], read_header(bundled_policies("ant-maze-easy7x7a", "expert")[0]).evaluation

    def counted(policy, task, episodes=100, **given):
        asked.append(episodes * task.max_steps)
        return known

    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 20)
    monkeypatch.setattr("dmcvb_gen.training.guided.TIMES_MORE_EPISODES", 3)
    monkeypatch.setattr(runs, "evaluate", counted)
    train(tmp_path / "run", case=case, steps=320, every=160)
    assert len(asked) == 2 and 0.5 * share * 320 < sum(asked) <= share * 320
    assert open_run(tmp_path / "long", config(case, every=10**6), False).evaluation_episodes() == most
    assert share * default_run(CASES[case][0], CASES[case][1])["evaluate_every"] / 600 > 4  # enough to pick medium from


def test_standing_states_stand():
    task = get_task("humanoid-walk")
    batch = task.batch(3)
    state = batch.set_physics(standing_states(task, np.random.default_rng(0), 3))
    assert (state[:, task.state_slices["head_height"]] > 1.4).all()
