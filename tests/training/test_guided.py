"""Policies that learn the way through a maze: what they learn, and what they may see."""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

import dmcvb_gen
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.open_maze import open_maze_observation, places
from dmcvb_gen.policies.policy_file import load_policy, read_header
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze.task import BEHAVIOUR_FIELDS, FIELDS
from dmcvb_gen.tasks.ant_maze.waypoints import AHEAD, headings
from dmcvb_gen.tasks.base import PHYSICS_SPEC
from dmcvb_gen.training import run as runs
from dmcvb_gen.training import selection
from dmcvb_gen.training.guided import Student, base_policy, draw_places
from dmcvb_gen.training.networks import WaypointNetwork, as_arrays
from dmcvb_gen.training.run import RunConfig, open_run
from tests.conftest import invoke


def config(task="ant-maze-easy7x7a", steps=640, **changes):
    settings = dict(simulations=8, batch_size=64, updates_per_step=0.5) | changes.pop("settings", {})
    fields = dict(algorithm="guided", seed=0, evaluate_every=steps)
    return RunConfig(task=task, steps=steps, settings=settings, **fields | changes)


def walked(task, steps=30, size=6):
    """A batch whose ants have tumbled about for a while."""
    batch, rng = task.batch(size), np.random.default_rng(3)
    batch.reset([np.random.default_rng(i) for i in range(size)])
    for _ in range(steps):
        batch.step(rng.uniform(-1, 1, (size, task.action_size)).astype(np.float32))
    return batch


def test_headed_is_what_an_ant_in_the_middle_of_an_open_maze_sees():
    import mujoco

    batch = walked(get_task("ant-maze-medium7x7a"))
    batch.set_physics(batch.physics())  # what is seen is of this very state, touch sensors too
    vector = np.random.default_rng(0).uniform(-3, 3, (6, 2))
    seen = open_maze_observation(batch.behaviour_observation(), vector)
    assert seen.dtype == np.float32

    # The same ants in another maze, their torsos moved to its middle, their goals to where they are told to go.
    open_task = get_task("ant-maze-empty7x7")
    other, physics = open_task.batch(6), batch.physics().copy()
    other.reset([np.random.default_rng(i) for i in range(6)])
    physics[:, 1:3] -= places(batch.behaviour_observation())[:, :2]
    goal = mujoco.mj_stateSize(open_task.model, PHYSICS_SPEC & (int(mujoco.mjtState.mjSTATE_MOCAP_POS) - 1))
    physics[:, goal : goal + 2] = vector
    other.set_physics(physics)
    ends = np.cumsum([FIELDS[name] for name in BEHAVIOUR_FIELDS])[:-1]
    fields = (np.split(values, ends, axis=1) for values in (seen, other.behaviour_observation()))
    for name, ours, theirs in zip(BEHAVIOUR_FIELDS, *fields, strict=True):
        if name != "sensors_touch":  # there are no walls to touch
            np.testing.assert_allclose(ours, theirs, atol=2e-5, err_msg=name)


def test_the_actor_and_the_network_that_learns_agree(tmp_path):
    """The policy that walks may know another maze's way, which goes."""
    walker = str(bundled_policies("ant-maze-medium7x7a", "expert")[0])
    run = open_run(tmp_path / "run", config(settings={"simulations": 6}, init_from=walker), False)
    base = base_policy(run)
    student = Student(run, base)
    policy = Policy(run.header, as_arrays(student.weights()), "")
    seen = walked(run.task).behaviour_observation()
    with torch.no_grad():
        learned = student.way(torch.from_numpy(places(seen))).numpy()
    np.testing.assert_allclose(policy.predict_waypoint(seen), learned, atol=1e-5)
    plain = Policy(base.header.model_copy(update={"way": None}), base.weights, "")
    wanted = plain.act(open_maze_observation(seen, policy.predict_waypoint(seen)), deterministic=True)
    np.testing.assert_array_equal(policy.act(seen, deterministic=True), wanted)
    assert (student.act(seen) == wanted).all(axis=1).tolist() == [True] * 3 + [False] * 3, "half act by their mean"


def test_places_are_drawn_on_the_floor():
    layout = get_task("ant-maze-medium7x7b").layout
    drawn = draw_places(layout, np.random.default_rng(0), 500)
    free = np.array([layout.world(cell) for cell in layout.free])
    for part, most in ((drawn[:, :2], 1.25), (drawn[:, 2:], 0.5)):
        nearest = np.abs(part[:, None] - free).max(axis=2).min(axis=1)
        assert nearest.max() <= most + 1e-6 and nearest.max() > 0.9 * most
    assert np.isfinite(headings(layout, drawn[:, :2], drawn[:, 2:], AHEAD)).all()


@pytest.mark.slow
def test_a_student_learns_where_its_guide_points(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 2)
    run = open_run(tmp_path / "run", config(), False)
    run.train()
    path = next((tmp_path / "run" / "checkpoints").iterdir())
    header, policy = read_header(path), load_policy(path, run.task)
    assert header.algorithm == "guided" and header.training["walker"] == base_policy(run).digest
    assert "--algo guided" in header.command and header.way == (256, 256, 256)
    for name, value in base_policy(run).weights.items():
        np.testing.assert_array_equal(policy.weights[name], value)

    place = draw_places(run.task.layout, np.random.default_rng(9), 500)
    told = torch.from_numpy(headings(run.task.layout, place[:, :2], place[:, 2:], AHEAD))
    way, errors = WaypointNetwork(header.way), []
    learned = {name: torch.tensor(policy.weights[f"way.{name}"]) for name in way.state_dict()}
    for weights in (way.state_dict(), learned):
        way.load_state_dict(weights)
        with torch.no_grad():
            errors.append(float(((way(torch.from_numpy(place)) - told) ** 2).sum(1).mean()))
    assert errors[1] < 0.5 * errors[0]


# -- a maze of one's own ----------------------------------------------------------------------------

SHORT = "--steps 448 --evaluate-every 64 --set ramp=200 --set simulations=16 --set width=64"
"""Enough to find the goal in a hall of two cells now and then."""


@pytest.mark.full
def test_the_documented_commands_of_ring_txt_take_a_sketch_to_a_verified_release(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "mazes.md").read_text()
    block = next(code for code in re.findall(r"```text\n(.*?)```", page, re.DOTALL) if "train-behaviour ring" in code)
    commands, select = [shlex.split(line)[1:] for line in block.splitlines()], selection.select_checkpoints
    assert len(commands) <= 6
    # Convergence, medium to a tenth and 100 episodes a checkpoint take minutes; the commands' way is the same.
    monkeypatch.setattr(selection, "converge", lambda *curve: selection.Convergence(-80.0, 0.0, True))
    monkeypatch.setattr(selection, "select_checkpoints", lambda folder, progress: select(folder, 5, progress=progress))
    monkeypatch.setattr(selection, "MEDIUM_TOLERANCE", 0.6)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ring.txt").write_text("****\n*  *\n****\n")
    for command in commands:
        short = {"train-behaviour": SHORT, "rollout": "--size 16 --max-steps 50"}.get(command[0], "").split()
        done = invoke(*command, *short, code=0)
        assert "***" not in done.output  # messages have the maze's name, not its rows
    release = dmcvb_gen.open(str(tmp_path / "ring"))
    assert sorted(name.split("/")[1] for name in release) == ["expert", "medium"]
    assert [release[name].array("length").shape for name in release] == [(20,), (20,)]


def test_a_maze_that_cannot_be_learned_is_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.txt").write_text("\n".join(["*" * 18, *["*" + " " * 16 + "*"] * 16, "*" * 18]))
    done = invoke("train-behaviour", "bad.txt", code=2)
    assert re.search("18 x 18 cells.* 15 x 15", done.output) and done.output.count("\n") == 1
    assert not os.path.exists("runs")
