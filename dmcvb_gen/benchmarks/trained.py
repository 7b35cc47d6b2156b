"""Load the trained policies that `validate` keeps, for `dmcvb_gen.evaluate`.

    agent = load_agent("reports/mini/cells/b1_walker-walk_none_state-bc_expert.safetensors")
    dmcvb_gen.evaluate(agent, "walker-walk/none", pixels=agent.pixels, stack=agent.stack)

A file holds the weights that act, the normalization of states, and a header with all that the networks are made from.
Nothing in it can run code.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from dmcvb_gen.agents.catalog import Agent, make_encoder, make_policy, parse_agent
from dmcvb_gen.agents.data import Normalization, Sizes, normalize_pixels
from dmcvb_gen.agents.learners import Policy
from dmcvb_gen.agents.networks import Architecture
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import replacing

FORMAT = "dmcvb-gen trained agent"


def save_agent(
    path: Path, policy: Policy, agent: Agent, sizes: Sizes, network: Architecture, normalization: Normalization
) -> None:
    """Write a trained policy.

    Args:
      sizes, network: sizes and network of the agent. normalization: normalization of the states that it learned from.
    """
    facts = {
        "format": FORMAT,
        "agent": agent.name,
        "sizes": dataclasses.asdict(sizes),
        "network": dataclasses.asdict(network),
        "half": policy.half,
    }
    tensors = {name: value for name, value in policy.state_dict().items() if policy.acts_by(name)}
    tensors |= {"normalization.mean": normalization.mean, "normalization.std": normalization.std}
    with replacing(path) as temporary:
        whole = {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
        save_file(whole, str(temporary), metadata={"facts": json.dumps(facts)})


@dataclass(frozen=True)
class TrainedAgent:
    """A trained policy, to call with a batch of observations as `dmcvb_gen.evaluate` gives them.

    Attributes:
      agent: its name, e.g. "id+bc". sizes: sizes of its observations and actions.
    """

    agent: Agent
    sizes: Sizes
    policy: Policy
    normalization: Normalization

    @property
    def pixels(self) -> bool:
        """True if it sees pictures."""
        return not self.agent.sees_state

    @property
    def stack(self) -> int:
        """Frames an observation."""
        return self.agent.stack

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return (episode, action) float32 in [-1, 1] for the observations of all episodes."""
        if self.pixels:
            seen = normalize_pixels(torch.from_numpy(observation["pixels"]))
        else:
            seen = self.normalization(torch.from_numpy(observation["state"]))
        with torch.no_grad(), self.policy.precision():
            return self.policy.act(seen).float().clamp(-1, 1).numpy()


def load_agent(path: str | Path) -> TrainedAgent:
    """The trained policy of a file that `validate` wrote beside a cell's result.

    Raises:
      DmcvbError: there is no such file, or it holds something else.
    """
    try:
        with safe_open(str(path), "pt") as file:
            facts = json.loads((file.metadata() or {}).get("facts", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        if facts.get("format") != FORMAT:
            raise ValueError("another format")
        normalization = Normalization(tensors.pop("normalization.mean"), tensors.pop("normalization.std"))
        agent, sizes, network = parse_agent(facts["agent"]), Sizes(**facts["sizes"]), Architecture(**facts["network"])
        if normalization.mean.shape != (sizes.state,) or normalization.std.shape != (sizes.state,):
            raise ValueError("the normalization does not fit")
        with torch.device("meta"):  # without memory: a file may name any size
            _check_shapes(_untrained(agent, sizes, network), tensors)
        policy = _untrained(agent, sizes, network)
        unexpected = policy.load_state_dict(tensors, strict=False).unexpected_keys
        if unexpected:
            raise ValueError(f"{unexpected[0]} does not fit")
        policy.half = bool(facts["half"])
    except (OSError, SafetensorError, RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise DmcvbError(f"{path} is no agent that validate trained ({reason})") from None
    return TrainedAgent(agent, sizes, policy.eval(), normalization)


def _untrained(agent: Agent, sizes: Sizes, network: Architecture) -> Policy:
    return make_policy(agent, make_encoder(agent, sizes, architecture=network), sizes, network)


def _check_shapes(policy: Policy, tensors: Mapping[str, torch.Tensor]) -> None:
    """Raise ValueError if a weight that acts is missing or has another shape than in the file."""
    for name, weight in policy.state_dict().items():
        if policy.acts_by(name) and (name not in tensors or tensors[name].shape != weight.shape):
            raise ValueError(f"{name} does not fit")
