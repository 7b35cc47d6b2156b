"""Readers give the stored values, and the pictures that a subset is about in the task's order."""

import functools

import numpy as np

import dmcvb_gen
from tests.conftest import stack_channels


def stack_of(values, views, step, frames, shown):
    """Frames of an episode up to a step, the first one repeated before it."""
    rows = np.maximum(np.arange(step - frames + 1, step + 1), 0)
    return stack_channels(values["pixels"][rows][:, [views.index(view) for view in shown]])


def test_every_form_gives_the_stored_steps_with_stacks_of_the_right_pictures(stored):
    for name, one in stored.items():
        subset = dmcvb_gen.open(str(one.folder))[name]
        (length, values, _), before = one.episode(1), int(subset.lengths[0])
        stack, agents = functools.partial(stack_of, values, one.views), one.views[:3]  # which see no overhead view
        for given, views in (({}, one.views), ({"pictures": "agents"}, agents)):
            [batch] = subset.batches(10**6, shuffle=False, **given)
            whole = subset.torch("episodes", **given)[1]
            np.testing.assert_array_equal(whole["pixels"], [stack(step, 1, views) for step in range(length + 1)])
            np.testing.assert_array_equal(whole["action"], values["action"])
            for held in (True, False):
                steps, source = (form(in_memory=held, **given) for form in (subset.torch, subset.source))
                transitions = subset.torch("transitions", in_memory=held, stack=2, **given)
                for step in (0, 1, 5, length - 1):
                    place = before + step
                    for item in (steps[place], source[place], {key: value[place] for key, value in batch.items()}):
                        assert (item["episode"], item["step"]) == (1, step)
                        np.testing.assert_array_equal(item["pixels"], stack(step, 3, views))
                        for array in ("state", "action", "reward"):
                            np.testing.assert_array_equal(item[array], values[array][step])
                    np.testing.assert_array_equal(transitions[place]["next_pixels"], stack(step + 1, 2, views))
                    np.testing.assert_array_equal(transitions[place]["next_state"], values["state"][step + 1])
        if len(one.views) > 1:
            two = subset.source(pictures=["follow", "top"], stack=1)[before + 5]["pixels"]
            np.testing.assert_array_equal(two, stack(5, 1, ["follow", "top"]))
