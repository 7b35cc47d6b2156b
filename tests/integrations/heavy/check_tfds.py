"""TensorFlow Datasets opens its exports: run by scripts/test_integrations.sh in a venv with TensorFlow."""

import json
import sys
from pathlib import Path

import numpy as np
import tensorflow as tf
import tensorflow_datasets as tfds

import dmcvb_gen

CAMERAS = {
    "pixels": "pixels",
    "top": "lowres_top_camera",
    "egocentric": "walker/egocentric_camera",
    "follow": "walker/follow_camera",
    "overhead": "walker/overhead_camera",
}


def check_steps(one):
    """tf.data takes a StepSource, as docs/reading.md shows it."""
    source = dmcvb_gen.open(one["release"])[one["subset"]].source(stack=3)
    signature = {name: tf.TensorSpec(value.shape, value.dtype) for name, value in source[0].items()}
    steps = tf.data.Dataset.from_generator(lambda: iter(source), output_signature=signature)
    place = 0
    for batch in steps.batch(32).as_numpy_iterator():
        for row in range(len(batch["step"])):
            for name, value in source[place].items():
                np.testing.assert_array_equal(batch[name][row], value)
            place += 1
    assert place == len(source)
    print(f"tf.data: {one['subset']}, {place} steps", flush=True)


work = Path(sys.argv[1])
for one in json.loads((work / "wanted.json").read_text()):
    stored = np.load(work / one["values"])
    [version] = Path(one["rlds"]).iterdir()
    data = tfds.builder_from_directory(str(version)).as_dataset(split="train")
    for index, episode in enumerate(data):
        steps = list(tfds.as_numpy(episode["steps"]))
        assert len(steps) == len(stored[f"action_{index}"]) + 1
        for step in (0, len(steps) // 2, len(steps) - 1):
            observation = steps[step]["observation"]
            for place, view in enumerate(map(str, stored["views"])):
                key = CAMERAS[view] + ("_hidden_target" if one["hidden"] else "")
                np.testing.assert_array_equal(observation[key], stored[f"pixels_{index}"][step, place])
            np.testing.assert_array_equal(observation["state"], stored[f"state_{index}"][step])
            if step < len(steps) - 1:
                np.testing.assert_array_equal(steps[step]["action"], stored[f"action_{index}"][step])
                assert steps[step]["reward"] == stored[f"reward_{index}"][step]
        assert steps[-1]["is_last"] and bool(steps[-1]["is_terminal"]) == bool(stored[f"terminated_{index}"])
    print(f"tfds: {one['subset']} opens, {index + 1} episodes", flush=True)
    check_steps(one)
