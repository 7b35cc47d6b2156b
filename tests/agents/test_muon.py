"""Muon beside torch's own, which takes matrices alone, and beside Adam."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from dmcvb_gen.agents.muon import Muon, is_hidden_matrix


def gradients(shape: tuple[int, ...], count: int = 6) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(shape, generator=generator) for _ in range(count)]


def descend(optimizer: torch.optim.Optimizer, weight: nn.Parameter, steps: list[torch.Tensor]) -> torch.Tensor:
    for gradient in steps:
        weight.grad = gradient.clone()
        optimizer.step()
    return weight.detach()


def torchs_muon(weight: nn.Parameter) -> torch.optim.Muon:
    return torch.optim.Muon([weight], lr=0.01, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")


@pytest.mark.parametrize("shape", [(48, 96), (96, 48), (64, 64)])
def test_matrices_move_as_by_torchs_muon(shape):
    start, steps = torch.randn(shape, generator=torch.Generator().manual_seed(0)), gradients(shape)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    half = descend(Muon([ours], 0.01, torch.bfloat16), ours, steps)
    expected = descend(torchs_muon(theirs), theirs, steps)
    moved = (expected - start).norm()
    assert (half - expected).norm() < 0.01 * moved
    exact = nn.Parameter(start.clone())
    assert (descend(Muon([exact], 0.01), exact, steps) - expected).norm() < 0.05 * moved  # theirs is in bfloat16


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_a_convolution_moves_as_its_matrix(layout):
    start, steps = torch.randn(64, 32, 3, 3), gradients((64, 32, 3, 3))
    ours = nn.Parameter(start.clone(memory_format=layout))
    matrix = nn.Parameter(start.permute(0, 2, 3, 1).flatten(1).clone())
    moved = descend(Muon([ours], 0.01), ours, steps)
    expected = descend(Muon([matrix], 0.01), matrix, [step.permute(0, 2, 3, 1).flatten(1) for step in steps])
    torch.testing.assert_close(moved.permute(0, 2, 3, 1).flatten(1), expected)


@pytest.mark.parametrize("shape", [(64,), (6, 256), (256, 6), (256, 4096), (256, 3, 3, 3)])
def test_all_else_moves_by_adam(shape):
    start, steps = torch.randn(shape), gradients(shape)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    assert not is_hidden_matrix(start)
    expected = descend(torch.optim.Adam([theirs], lr=0.01, fused=True), theirs, steps)
    torch.testing.assert_close(descend(Muon([ours], 0.01), ours, steps), expected, rtol=0, atol=0)


@pytest.mark.parametrize("other, settings", [
    (torch.optim.SGD, {}), (torch.optim.AdamW, {}), (torch.optim.Adam, {"betas": (0.5, 0.9)}),
    (torch.optim.Adam, {"eps": 1e-5}), (torch.optim.Adam, {"weight_decay": 0.1}), (torch.optim.Adam, {"amsgrad": True}),
])  # fmt: skip
def test_an_optimizer_that_an_agent_chose_stays_with_its_settings(other, settings):
    weight = nn.Parameter(torch.randn(64, 64))
    chosen = other([weight], lr=0.01, **settings)
    assert Muon.instead_of(chosen, torch.float32) is chosen
    plain = torch.optim.Adam([weight], lr=0.02)
    [group] = Muon.instead_of(plain, torch.float32).param_groups
    assert group["lr"] == 0.02 and group["params"][0] is weight
