"""Agents by name: "id+bc" in, what pre-trains its encoder and what learns its policy out.

    MODULE:NAME                                           a user's own agent (`benchmarks.own`)
    [PRETRAIN+]POLICY[:frames=N,k=N,sample,unbounded]

PRETRAIN is one of id, lfd, ae, state, dino, bc (its encoder is then frozen) or null (none: the policy trains its
encoder); POLICY is bc or td3-bc (with `unbounded`, its critics lack the paper's tanh). state-bc and state-td3-bc see
states instead of pictures.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from torch import nn

from dmcvb_gen.agents.data import FRAMES, Sizes
from dmcvb_gen.agents.dino import load_dino
from dmcvb_gen.agents.learners import (
    TD3BC,
    Autoencoder,
    BehaviorCloning,
    InverseDynamics,
    LatentForwardDynamics,
    Learner,
    Policy,
    StatePrediction,
)
from dmcvb_gen.agents.networks import PAPER, Architecture, Convolutions, Encoder, observation_encoder, state_encoder
from dmcvb_gen.errors import DmcvbError, UnknownNameError

PRETRAIN = ("id", "lfd", "ae", "state", "dino", "bc")
POLICIES = ("bc", "td3-bc")
OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""A user's own agent: "module:name"."""
AGENTS = (
    *POLICIES,
    *(f"state-{policy}" for policy in POLICIES),
    *(f"{pretrain}+{policy}" for policy in POLICIES for pretrain in PRETRAIN),
)
"""The names that `parse_agent` takes, options left out."""


@dataclass(frozen=True)
class Agent:
    """An agent.

    Attributes:
      policy: "bc" or "td3-bc".
      pretrain: what makes the frozen encoder; None: trained with the policy.
      sees_state: states instead of pictures.
      stack: frames an observation.
      k, sample_k: of inverse dynamics.
      unbounded: TD3-BC's critics end without tanh.
      own: "module:name" of a user's agent, instead of all this.
    """

    policy: str
    pretrain: str | None = None
    sees_state: bool = False
    stack: int = FRAMES
    k: int = 1
    sample_k: bool = False
    unbounded: bool = False
    own: str | None = None

    @property
    def base(self) -> str:
        """The name without options."""
        if self.sees_state:
            return f"state-{self.policy}"
        return f"{self.pretrain}+{self.policy}" if self.pretrain else self.policy

    @property
    def name(self) -> str:
        if self.own:
            return self.own
        options = [f"frames={self.stack}"] if self.stack != FRAMES and not self.sees_state else []
        options += [f"k={self.k}"] if self.k != 1 else []
        options += ["sample"] if self.sample_k else []
        options += ["unbounded"] if self.unbounded else []
        return self.base + (":" + ",".join(options) if options else "")

    @property
    def paper_name(self) -> str | None:
        """The column of the paper's table; None where it has none."""
        if self.own or ":" in self.name or (self.sees_state and self.policy != "bc"):
            return None
        if self.sees_state:
            return "bc(state)"
        return f"{self.pretrain or 'null'}+{self.policy}"


def parse_agent(name: str) -> Agent:
    """The agent of a name.

    Raises:
      UnknownNameError, DmcvbError: no such agent or option, or one that this agent has no use for.
    """
    if OWN.fullmatch(name.strip()) and name.partition(":")[0].lower() not in AGENTS:
        return Agent("bc", own=name.strip())
    base, _, options = name.strip().lower().partition(":")
    base = {"bc(state)": "state-bc", "td3-bc(state)": "state-td3-bc"}.get(base, base).removeprefix("null+")
    if base not in AGENTS:
        raise UnknownNameError("agent", name, AGENTS)
    values = {"stack": FRAMES, "k": 1, "sample_k": False, "unbounded": False}
    for option in filter(None, options.split(",")):
        key, _, value = option.partition("=")
        if key == "sample" and not value:
            values["sample_k"] = True
        elif key == "unbounded" and not value:
            values["unbounded"] = True
        elif key in ("frames", "k") and value.isdigit() and 1 <= int(value) <= 64:
            values["stack" if key == "frames" else "k"] = int(value)
        else:
            raise DmcvbError(
                f"agent {name!r}: {option!r} is not an option; known: frames=1..64, k=1..64, sample, unbounded"
            )
    if base.startswith("state-"):
        agent = Agent(base.removeprefix("state-"), sees_state=True, **values)
    else:
        pretrain, plus, policy = base.rpartition("+")
        agent = Agent(policy, pretrain if plus else None, **values)
    _check_heard(agent, name)
    return agent


def _check_heard(agent: Agent, name: str) -> None:
    """Refuse options that would make another name of the same training."""
    if agent.sees_state and agent.stack != FRAMES:
        raise DmcvbError(f"agent {name!r}: states are not stacked; leave frames=... out")
    if agent.pretrain != "id" and (agent.k != 1 or agent.sample_k):
        raise DmcvbError(f"agent {name!r}: k and sample are of inverse dynamics (id+bc:k=5); leave them out")
    if agent.unbounded and agent.policy != "td3-bc":
        raise DmcvbError(f"agent {name!r}: only the critics of td3-bc can be unbounded; remove it")
    if agent.sample_k and agent.k == 1:
        raise DmcvbError(f"agent {name!r}: sample draws k from 1 to a largest one; give it, k=2 or more")


def make_encoder(
    agent: Agent, sizes: Sizes, dino_weights: str | Path | None = None, architecture: Architecture = PAPER
) -> nn.Module:
    """phi of an agent, untrained (or DINO's).

    Raises:
      DmcvbError: DINO's weights are asked for and not at hand.
    """
    if agent.sees_state:
        return state_encoder(sizes.state)
    if agent.pretrain == "dino":
        return load_dino(dino_weights, sizes.channels, sizes.picture)
    return observation_encoder(sizes.channels, sizes.picture, architecture, sizes.stack)


def make_pretrainer(agent: Agent, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER) -> Learner:
    """What pre-trains phi."""
    actions, states = sizes.action, sizes.state
    makers = {
        "id": lambda: InverseDynamics(encoder, actions, agent.k, agent.sample_k),
        "lfd": lambda: LatentForwardDynamics(encoder, actions),
        "ae": lambda: Autoencoder(encoder, sizes.channels, sizes.picture, architecture),
        "state": lambda: StatePrediction(encoder, states),
        "bc": lambda: BehaviorCloning(encoder, actions),
    }
    return makers[agent.pretrain]()


def make_policy(agent: Agent, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER) -> Policy:
    """What learns the policy, on the pre-trained encoder (frozen) or with one of its own."""
    actions, frozen = sizes.action, agent.pretrain is not None
    if agent.policy == "bc":
        return BehaviorCloning(encoder, actions, frozen=frozen)
    bounded = not agent.unbounded
    if frozen:
        return TD3BC(encoder, encoder.features, actions, frozen=True, bounded=bounded)
    if agent.sees_state:
        return TD3BC(nn.Identity(), sizes.state, actions, bounded=bounded)
    body = Convolutions(sizes.channels, sizes.picture, architecture, sizes.stack)
    return TD3BC(body, body.features, actions, bounded=bounded, latent=architecture.latent)
