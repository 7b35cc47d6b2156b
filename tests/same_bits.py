"""Digests of one short episode a task, as JSON: run by test_same_bits.py here and under emulated processors.

python -m tests.same_bits <agent steps> <task>...
"""

import hashlib
import json
import sys

import numpy as np

from dmcvb_gen.distractors import load_backgrounds, sample_distractors
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.rendering import renderer_class
from dmcvb_gen.seeding import STREAMS, episode_stream
from dmcvb_gen.spec import LOCOMOTION, parse_setting
from dmcvb_gen.tasks import get_task

EPISODES = 2


def digest(*arrays: np.ndarray) -> str:
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array))
    return sha.hexdigest()[:16]


def digests(task_id: str, steps: int) -> dict[str, str]:
    """Of what an expert's episodes store: mean and drawn actions, physics, states, rewards, labels, pictures."""
    task = get_task(task_id)
    policy = load_policy(bundled_policies(task_id, "expert")[0], task)
    names, episodes = (task_id, "same bits"), range(EPISODES)
    out = simulate(task, [policy], episodes, 0, names, max_steps=steps)
    drawn = simulate(task, [policy], episodes, 0, names, max_steps=2, deterministic=False)
    found = {name: digest(getattr(out, name)) for name in ("action", "physics", "state", "reward")}
    found["drawn actions"] = digest(drawn.action)
    # Actions and labels once more from what is the same everywhere, whatever the steps of the physics gave.
    batch = task.batch(EPISODES)
    batch.reset([episode_stream(0, names, i, "initial_state") for i in episodes])
    start = batch.physics()
    found["start"] = digest(start)
    found["action at the start"] = digest(policy.act(batch.behaviour_observation(), deterministic=True))
    physics = np.repeat(start[:, None], steps + 1, axis=1)
    for setting in ("none", "dynamic") if task.family == LOCOMOTION else ("visible",):
        streams = {name: [episode_stream(0, names, i, name) for i in episodes] for name in STREAMS}
        distractors = parse_setting(task_id, setting)[0]
        backgrounds = load_backgrounds("builtin", "train") if distractors.kind != "none" else None
        labels = sample_distractors(task, distractors, physics, streams, backgrounds, split="train")
        found[f"labels {setting}"] = digest(*(value for _, value in labels.items()))
        painter = renderer_class("native")(task, 64, backgrounds=backgrounds)
        found[f"pictures {setting}"] = digest(painter.render(start, labels[:, 0]))
        painter.close()
    return found


if __name__ == "__main__":
    given, *tasks = sys.argv[1:]
    print(json.dumps({task: digests(task, int(given)) for task in tasks}))
