"""Muon: matrices move by orthogonalized momentum, all else by Adam.

A step of Adam can be large along a few directions of a matrix and small along all others; Muon makes it equally large
along all (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks"). Steps are scaled to the size
of Adam's, so that both take the same learning rate (Liu et al. 2025, "Muon is scalable for LLM training", section 2.2).

torch.optim.Muon makes the same steps, of linear maps alone and in bfloat16 alone: on a processor that emulates bfloat16
a 256 x 256 matrix takes it 360 ms, and 9 ms here in float32.
"""

from __future__ import annotations

import torch

MOMENTUM = 0.95
ITERATIONS = 5
COEFFICIENTS = 3.4445, -4.7750, 2.0315
"""Coefficients of the polynomial that moves singular values towards 1 (Jordan et al. 2024)."""
SCALE = 0.2
"""Root mean square of Adam's usual step, in learning rates (Liu et al. 2025)."""
FEWEST, LARGEST = 32, 2**18
"""Matrices with fewer rows or columns move by Adam, as output layers should. So do those with more weights: the linear
map of an encoder's trunk would take more time than all of the rest."""


def is_hidden_matrix(weight: torch.Tensor) -> bool:
    """True if a weight moves by orthogonalized momentum: of a linear map, or a convolution as (out, in x k x k)."""
    sides = (weight.shape[0], weight[0].numel()) if weight.ndim > 1 else (0,)
    return min(sides) >= FEWEST and weight.numel() <= LARGEST


def orthogonalize(matrix: torch.Tensor) -> torch.Tensor:
    """(row, column) -> a matrix with the same singular vectors, and singular values of about 1 (0.7 to 1.2).

    Small ones stay smaller: an iteration multiplies them by 3.4 at most. Newton and Schulz's iteration needs matrix
    products alone, and bfloat16 is enough for them.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalize(matrix.T).T
    a, b, c = COEFFICIENTS
    found = matrix / (matrix.norm() + 1e-12)
    for _ in range(ITERATIONS):
        square = found @ found.T
        found = torch.addmm(found, torch.addmm(square, square, square, beta=b, alpha=c), found, beta=a)
    return found


class Muon(torch.optim.Adam):
    """Adam, but for hidden matrices (`is_hidden_matrix`).

    Args:
      parameters: all trainable parameters.
      lr: learning rate of both.
      dtype: what matrices are orthogonalized in: bfloat16 if the processor is fast at it.
    """

    def __init__(self, parameters, lr: float, dtype: torch.dtype = torch.float32):
        super().__init__(parameters, lr=lr, fused=True)
        self.dtype = dtype

    @torch.no_grad()
    def step(self, closure=None):
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is not None and is_hidden_matrix(weight):
                    self._move(weight, group["lr"])
                    weight.grad = None  # Adam leaves it alone then
        return super().step(closure)

    @classmethod
    def instead_of(cls, optimizer: torch.optim.Optimizer, dtype: torch.dtype) -> torch.optim.Optimizer:
        """One over the parameters of an Adam that has torch's own settings, at its learning rate.

        An agent may have chosen another optimizer, or other settings: that one is returned unchanged.
        """
        group, *others = optimizer.param_groups
        usual = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))]).defaults
        chosen = [name for name in usual if name not in ("lr", "fused", "foreach") and group.get(name) != usual[name]]
        if type(optimizer) is not torch.optim.Adam or others or chosen:
            return optimizer
        return cls(group["params"], group["lr"], dtype)

    def _move(self, weight: torch.Tensor, lr: float) -> None:
        gradient, state = weight.grad, self.state[weight]
        if not state:
            state |= {"step": torch.zeros((), device=weight.device), "momentum": torch.zeros_like(weight)}
        state["step"] += 1  # Adam looks for it in every state that it loads
        momentum = state["momentum"]
        momentum.lerp_(gradient, 1 - MOMENTUM)
        ahead = gradient.lerp(momentum, MOMENTUM)  # Nesterov's
        # Convolutions lie with the channels last in memory, so that this order of columns takes no copy.
        matrix = ahead.movedim(1, -1).flatten(1)
        step = orthogonalize(matrix.to(self.dtype)).to(weight.dtype) * (SCALE * max(matrix.shape) ** 0.5)
        weight.add_(step.view_as(ahead.movedim(1, -1)).movedim(-1, 1), alpha=-lr)
