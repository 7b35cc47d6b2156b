"""Students of a guide through mazes: what they learn, and what they may see."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dmcvb_gen.behaviours.learning import runs
from dmcvb_gen.behaviours.learning.guided import GuidedRun, Imitation, deepened, divergence
from dmcvb_gen.behaviours.learning.networks import Actor, as_tensors
from dmcvb_gen.behaviours.learning.runs import RunConfig
from dmcvb_gen.behaviours.learning.training import open_run
from dmcvb_gen.behaviours.policies.policy_file import load_policy, read_header
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze.task import BEHAVIOUR_FIELDS, FIELDS


def config(task="ant-maze-easy7x7a", steps=640, **changes):
    settings = dict(simulations=8, batch_size=32, updates_per_step=0.25) | changes.pop("settings", {})
    fields = dict(algorithm="guided", seed=0, evaluate_every=steps, evaluate_sparse=steps)
    return RunConfig(task=task, steps=steps, settings=settings, **fields | changes)


def test_divergence_is_torchs():
    rng = torch.Generator().manual_seed(0)
    mean, own_mean = (torch.randn(20, 3, generator=rng) for _ in range(2))
    std, own_std = (torch.rand(20, 3, generator=rng) + 0.1 for _ in range(2))
    normal = torch.distributions.Normal
    wanted = torch.distributions.kl_divergence(normal(mean, std), normal(own_mean, own_std)).sum(dim=1).mean()
    torch.testing.assert_close(divergence(mean, std, own_mean, own_std), wanted)


def test_saturated_actions_need_not_be_met_to_the_digit():
    std = torch.full((1, 1), 0.5)
    same = divergence(torch.tensor([[3.5]]), std, torch.tensor([[9.0]]), std)
    assert float(same) == 0
    assert float(divergence(torch.tensor([[3.5]]), std, torch.tensor([[2.0]]), std)) > 1


def test_a_deeper_student_begins_as_its_guide(tmp_path):
    torch.manual_seed(0)
    run = open_run(tmp_path / "run", config(settings={"layers": 4}), False)
    weights = as_tensors(run.guide.weights)
    student, guide = Actor(run.header), Actor(run.guide.header)
    assert run.header.hidden == (256, 256, 256, 256) and run.guide.header.hidden == (256, 256)
    student.load_state_dict(deepened(weights, student.state_dict()))
    guide.load_state_dict(weights)
    begun = {fresh: begin(tmp_path / f"fresh_{fresh}", fresh) for fresh in (False, True)}
    for name, value in as_tensors(weights).items():
        assert torch.equal(begun[False][name], value)
        assert torch.equal(begun[True][name], value) == name.startswith("observation")
    observation = weights["observation_mean"] + torch.randn(64, run.header.observation_size)
    for own, other in zip(student(observation), guide(observation), strict=True):
        torch.testing.assert_close(own, other)


def begin(folder, fresh):
    """The weights that a student begins with."""
    (folder / "resume").mkdir(parents=True)
    return Imitation(GuidedRun(folder, config(settings={"fresh": fresh}))).student.state_dict()


def test_a_student_sees_the_goal_and_its_guide_the_way():
    task = get_task("ant-maze-medium7x7a")
    batch = task.batch(4)
    batch.reset([np.random.default_rng(i) for i in range(4)])
    ends = np.cumsum([FIELDS[name] for name in BEHAVIOUR_FIELDS])[:-1]
    own, shown = (
        dict(zip(BEHAVIOUR_FIELDS, np.split(seen, ends, axis=1), strict=True))
        for seen in (batch.behaviour_observation(), batch.guided_observation(2.0))
    )
    told = ("target_position", "target_vector", "egocentric_target_vector", "walker_position")
    for name in set(BEHAVIOUR_FIELDS) - set(told):
        np.testing.assert_array_equal(own[name], shown[name])
    apart = shown["target_position"] - shown["walker_position"]
    np.testing.assert_allclose(apart, shown["target_vector"], atol=1e-6)
    for seen in (own, shown):
        lengths = (np.linalg.norm(seen[name], axis=1) for name in ("target_vector", "egocentric_target_vector"))
        np.testing.assert_allclose(*lengths, rtol=1e-5)
    assert (shown["walker_position"][:, :2] == 0).all()


def test_a_student_comes_nearer_to_its_guide(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 2)
    run = open_run(tmp_path / "run", config(), False)
    losses, update = [], Imitation.update
    monkeypatch.setattr(Imitation, "update", lambda *args: losses.append(update(*args)) or losses[-1])
    run.train()
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:20])
    header = read_header(next((tmp_path / "run" / "checkpoints").iterdir()))
    assert header.algorithm == "guided" and header.training["guide"] == run.guide.digest
    assert "--algo guided" in header.command
    assert load_policy(next((tmp_path / "run" / "checkpoints").iterdir()), run.task).digest != run.guide.digest


def test_a_run_does_not_go_on_with_another_guide(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 2)
    open_run(tmp_path / "run", config(steps=64, evaluate_every=10_000, evaluate_sparse=10_000), False).train()
    longer = open_run(tmp_path / "run", config(steps=128, evaluate_every=10_000, evaluate_sparse=10_000), True)
    longer.guide.digest = "another"
    with pytest.raises(DmcvbError, match="another guide"):
        longer.train()


def test_what_cannot_be_guided(tmp_path):
    with pytest.raises(DmcvbError, match="for ant mazes"):
        open_run(tmp_path / "run", config(task="walker-walk"), False)
    with pytest.raises(DmcvbError, match="unknown setting of guided"):
        open_run(tmp_path / "run", config(settings={"progress": 1.0}), False)
    assert not (tmp_path / "run").exists()
