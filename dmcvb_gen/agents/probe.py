"""Linear probes: how much of the true actions a linear map of latent actions gives."""

from __future__ import annotations

import torch
from torch.nn import functional as F

from dmcvb_gen.agents.data import ENCODED_ROWS, TrainingData
from dmcvb_gen.agents.learners import Learner

PROBED = 20_000
"""Transitions that a probe is fitted to, and tested on, at most."""


def action_probe(learner: Learner, data: TrainingData) -> float | None:
    """The `linear_probe` of a learner's latent actions, tested on held-out episodes; None if nothing is held out."""
    if not len(data.hold_out_rows):
        return None
    return linear_probe(*_actions(learner, data, data.train_rows), *_actions(learner, data, data.hold_out_rows))


@torch.no_grad()
def _actions(learner: Learner, data: TrainingData, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(row, latent) latent and (row, action) true actions of some of the transitions at rows, evenly spread."""
    few = rows[:: max(1, -(-len(rows) // PROBED))]
    batches = [data.transitions(some, torch.ones_like(some)) for some in few.split(ENCODED_ROWS)]
    return torch.cat([learner.latent_action(batch) for batch in batches]), data.action[few]


def linear_probe(
    latent: torch.Tensor, action: torch.Tensor, test_latent: torch.Tensor, test_action: torch.Tensor
) -> float:
    """Mean squared error of the least-squares map, over the variance of the actions: 0 says all of them, 1 nothing.

    Args:
      latent, action: (row, latent) and (row, action), which the map is fitted to.
      test_latent, test_action: the same, on which it is tested.
    """
    inputs, test_inputs = (F.pad(each.double().cpu(), (0, 1), value=1.0) for each in (latent, test_latent))
    wanted, test_wanted = action.double().cpu(), test_action.double().cpu()
    weights = torch.linalg.lstsq(inputs, wanted, driver="gelsd").solution
    error = (test_inputs @ weights - test_wanted).square().mean()
    return float(error / test_wanted.var(dim=0, correction=0).mean())
