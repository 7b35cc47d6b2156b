"""A distractor: `--distractor my_file:Grey` gives every material one grey, drawn for each episode."""

import numpy as np

from dmcvb_gen.distractors import Distractor


class Grey(Distractor):
    """Every material has the same grey, uniform within s of the middle."""

    kinds = ("grey",)  # settings that vary it: grey, grey_easy, grey_hard
    stream = "color"  # the episode's random stream to draw from
    names = ("material_rgb",)  # the labels that it gives; all others stay the task's own

    def __init__(self, scene, generators):
        shape = (scene.frames, *scene.task.material_colors.shape)
        scale = scene.setting.scale
        greys = np.stack([np.full(shape, 0.5 + scale * rng.uniform(-1, 1)) for rng in generators])
        self.drawn = {"material_rgb": greys}
