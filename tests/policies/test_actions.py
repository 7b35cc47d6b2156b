"""Which actions a release takes: mean ones by default, drawn ones on request, uniform ones at level random."""

from __future__ import annotations

import pytest

from dmcvb_gen.generate.plan import make_plan
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.tasks import get_task


@pytest.mark.parametrize("task, setting", [("walker-walk", "none"), ("ant-maze-empty7x7", "visible")])
def test_recipes_take_mean_actions_unless_told_to_draw_and_manifests_say_so(tmp_path, task, setting):
    def planned(**fields):
        subset = dict(tasks=task, levels=["expert", "random"], settings=setting, episodes=1) | fields
        recipe = make_recipe({"name": "actions", "subsets": [subset]})
        return [record.deterministic for record in make_plan(recipe, tmp_path / "r").release.manifest.subsets]

    assert planned() == [True, False]
    assert planned(deterministic=False) == [False, False]


@pytest.mark.parametrize("task_id", ["walker-walk", "ant-maze-empty7x7"])
def test_mean_actions_are_taken_by_default_and_drawn_ones_scatter_around_them(task_id):
    task = get_task(task_id)
    policy = load_policy(bundled_policies(task_id, "expert")[0], task)
    mean, drawn, again = (
        simulate(task, [policy], range(3), 0, (task_id,), max_steps=3, deterministic=deterministic)
        for deterministic in (True, False, False)
    )
    default = simulate(task, [policy], range(3), 0, (task_id,), max_steps=3)
    assert (default.action == mean.action).all() and (drawn.action == again.action).all()
    first = mean.action[:, 0]
    batch = task.batch(3)
    batch.reset([episode_stream(0, (task_id,), i, "initial_state") for i in range(3)])
    assert (policy.act(batch.behaviour_observation(), deterministic=True) == first).all()
    assert 0.01 < abs(drawn.action[:, 0] - first).mean() < 1
