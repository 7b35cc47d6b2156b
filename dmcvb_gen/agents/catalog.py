"""Find agents by name: "id+bc" is an encoder pre-trained by inverse dynamics with a policy by BC.

    [PRETRAIN+]POLICY[:OPTION...]

POLICY and PRETRAIN are names that `learners.register_agent` knows. With PRETRAIN the encoder is pre-trained and then
frozen ("null": none, the policy trains its encoder); state-POLICY sees states instead of pictures. The options are
frames=N, of all agents that see pictures, and those of the two parts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import nn

from dmcvb_gen.agents.data import FRAMES, Sizes
from dmcvb_gen.agents.dino import DinoEncoder
from dmcvb_gen.agents.learners import PARTS, Learner, Policy
from dmcvb_gen.agents.networks import PAPER, Architecture, Encoder, observation_encoder, state_encoder
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.own_code import source_digest

MOST = 64
"""The largest number that an option takes."""


def agent_names() -> tuple[str, ...]:
    """The names that `parse_agent` takes, options left out."""
    own = [name for name, part in PARTS.all().items() if issubclass(part, Policy)]
    encoders = [name for name, part in PARTS.all().items() if part.pretrains]
    return (*own, *(f"state-{name}" for name in own), *(f"{encoder}+{name}" for name in own for encoder in encoders))


@dataclass(frozen=True)
class Agent:
    """An agent.

    Attributes:
      policy: the part that acts: "bc", "td3-bc".
      pretrain: the part that makes the frozen encoder; None: it is trained with the policy.
      sees_state: states instead of pictures.
      stack: frames an observation.
      options: (name, value) of the two parts' options that are not at their defaults, in the parts' order.
    """

    policy: str
    pretrain: str | None = None
    sees_state: bool = False
    stack: int = FRAMES
    options: tuple[tuple[str, int | bool], ...] = ()

    @property
    def base(self) -> str:
        """The name without options."""
        if self.sees_state:
            return f"state-{self.policy}"
        return f"{self.pretrain}+{self.policy}" if self.pretrain else self.policy

    @property
    def name(self) -> str:
        options = [f"frames={self.stack}"] if self.stack != FRAMES else []
        options += [name if value is True else f"{name}={value}" for name, value in self.options]
        return ":".join([self.base, *options])

    @property
    def paper_name(self) -> str:
        """The name as agents are named in the paper's table, which has few of them."""
        base = f"{self.policy}(state)" if self.sees_state else f"{self.pretrain or 'null'}+{self.policy}"
        return base + self.name.removeprefix(self.base)

    @property
    def sees_by_dino(self) -> bool:
        """True if its encoder comes trained from a file."""
        return self.pretrain == "dino"

    @property
    def pretraining(self) -> Agent:
        """The agent that stands for all that share its encoder."""
        return Agent("bc", self.pretrain, stack=self.stack, options=tuple(self.options_of(self.pretrain).items()))

    def options_of(self, part: str | None) -> dict[str, int | bool]:
        """Those of its options that one of its parts takes."""
        return {name: value for name, value in self.options if part and name in PARTS.get(part).options}

    def foreign_code(self) -> dict[str, str]:
        """Part -> SHA-256 of its module's file, of parts from other packages: one that changed is trained again."""
        modules = {part: PARTS.get(part).__module__ for part in (self.policy, self.pretrain) if part}
        return {part: source_digest(module) for part, module in modules.items() if not module.startswith("dmcvb_gen.")}


def parse_agent(name: str) -> Agent:
    """The agent of a name.

    Raises:
      UnknownNameError, DmcvbError: no such agent or option, or one that this agent has no use for.
    """
    known = agent_names()
    base, _, options = name.strip().lower().partition(":")
    if base not in known:
        raise UnknownNameError("agent", name, known)
    if base.startswith("state-"):
        agent = Agent(base.removeprefix("state-"), sees_state=True)
    else:
        pretrain, _, policy = base.rpartition("+")
        agent = Agent(policy, pretrain or None)
    defaults = {} if agent.sees_state else {"frames": FRAMES}
    for part in filter(None, (agent.pretrain, agent.policy)):
        defaults |= PARTS.get(part).options
    values: dict[str, int | bool] = {}
    for option in filter(None, options.split(":")):
        key, _, value = option.partition("=")
        kind = type(defaults.get(key))
        if kind is bool and not value:
            values[key] = True
        elif kind is int and value.isdecimal() and 1 <= int(value) <= MOST:
            values[key] = int(value)
        else:
            takes = [name if isinstance(default, bool) else f"{name}=1..{MOST}" for name, default in defaults.items()]
            what = f"{option!r} is not an option of agent {agent.base}"
            raise DmcvbError(f"{what}; it takes {', '.join(takes) or 'none'}")
    agent = replace(agent, stack=int(values.pop("frames", FRAMES)))
    changed = tuple((key, values[key]) for key in defaults if values.get(key, defaults[key]) != defaults[key])
    return replace(agent, options=changed)


def make_encoder(
    agent: Agent, sizes: Sizes, weights: str | Path | None = None, architecture: Architecture = PAPER
) -> nn.Module:
    """phi of an agent, untrained, or of a file of weights.

    Raises:
      DmcvbError: the file holds others.
    """
    if agent.sees_state:
        return state_encoder(sizes.state)
    if agent.sees_by_dino:
        return DinoEncoder.load(weights, sizes.channels, sizes.picture)
    return observation_encoder(sizes.channels, sizes.picture, architecture, sizes.stack)


def make_pretrainer(agent: Agent, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER) -> Learner:
    """Make the learner that pre-trains phi."""
    return PARTS.get(agent.pretrain)(encoder, sizes, architecture, **agent.options_of(agent.pretrain))


def make_policy(agent: Agent, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER) -> Policy:
    """Make the learner of the policy, on the pre-trained encoder (frozen) or with one of its own."""
    frozen = agent.pretrain is not None
    return PARTS.get(agent.policy)(encoder, sizes, architecture, frozen=frozen, **agent.options_of(agent.policy))
