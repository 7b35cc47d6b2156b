"""Updates that a GPU records once and replays: asking for a small network's kernels takes longer than running them.

A CUDA graph repeats the same kernels on the same memory. So a step's random numbers, drawn on the host as for an update
in turn, are copied to where the recorded draw of a batch reads them, and the learning rate is a number on the GPU.
"""

from __future__ import annotations

import numpy as np
import torch

from dmcvb_gen.agents.data import TrainingData
from dmcvb_gen.agents.learners import Learner

WARM_UP = 3
"""Updates before the recording, in which optimizers and libraries allocate what they keep."""
AHEAD = 8
"""Updates that the host may ask for before the GPU has made them."""


def can_record(learner: Learner, data: TrainingData) -> bool:
    """True if data and learner are on a GPU, and every update of the learner is the same sequence of kernels."""
    mapped = data.frames is not None and data.frames.mapped
    said = vars(type(learner)).get("recordable", False)  # by the class itself: one derived from it may update otherwise
    return data.device.type == "cuda" and said and not mapped


def prepare(learner: Learner) -> None:
    """Make the learner's optimizers ones that can be recorded: their learning rates lie on the GPU."""
    device = next(learner.parameters()).device
    for optimizer in learner.optimizers.values():
        for group in optimizer.param_groups:
            group["capturable"] = True
            group["lr"] = torch.tensor(float(group["lr"]), device=device)


class RecordedUpdate:
    """Draws a batch and makes one update of a learner; recorded at the call after `WARM_UP`, replayed from then on.

    Args:
      learner: one that is `recordable`, with `prepare`d optimizers. data: on the same GPU.
      size: transitions a batch.
      shift: pictures are shifted at random.
    """

    def __init__(self, learner: Learner, data: TrainingData, size: int, shift: bool):
        self._learner, self._data, self._size = learner, data, size
        self._rows = data.candidates(learner.k_max if learner.needs_next else 1)
        self._shift = shift and data.can_shift
        self._drawn = torch.zeros((4, size), dtype=torch.long, device=data.device)  # index, down, right, steps
        self._sent = torch.zeros((AHEAD, *self._drawn.shape), dtype=torch.long, pin_memory=True)
        self._arrived = [torch.cuda.Event() for _ in range(AHEAD)]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._losses: dict[str, torch.Tensor] = {}
        self._calls = 0

    def __call__(self, generator: np.random.Generator) -> dict[str, torch.Tensor]:
        """The losses of one update, which the next one writes over."""
        self._send(generator)
        self._calls += 1
        if self._graph is not None:
            self._graph.replay()
        elif self._calls <= WARM_UP:
            self._warm_up()
        else:
            self._record()
        return self._losses

    def _send(self, generator: np.random.Generator) -> None:
        """Draw on the host, and copy it to where the update reads it, without waiting for the GPU."""
        learner, slot = self._learner, self._calls % AHEAD
        picks = self._data.pick(
            len(self._rows), self._size, generator, learner.needs_next, learner.k_max, learner.sample_k, self._shift
        )
        self._arrived[slot].synchronize()  # its last copy is through
        sent = self._sent[slot]
        for row, values in enumerate(picks):
            if values is not None:
                sent[row] = torch.from_numpy(values)
        self._drawn.copy_(sent, non_blocking=True)
        self._arrived[slot].record()

    def _update(self) -> None:
        learner = self._learner
        index, down, right, steps = self._drawn
        batch = self._data.transitions(
            self._rows[index],
            steps if learner.needs_next else None,
            *((down, right) if self._shift else (None, None)),
            dtype=torch.bfloat16 if learner.half else torch.float32,
            pictures=learner.needs_pictures,
        )
        self._losses = learner.update(batch)

    def _warm_up(self) -> None:
        """Update on a stream of its own, as recording will."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), torch.backends.cudnn.flags(enabled=True, benchmark=True):
            self._update()
        torch.cuda.current_stream().wait_stream(stream)

    def _record(self) -> None:
        self._graph = torch.cuda.CUDAGraph()
        with torch.backends.cudnn.flags(enabled=True, benchmark=True), torch.cuda.graph(self._graph):
            self._update()
        self._graph.replay()  # recording alone moves nothing
