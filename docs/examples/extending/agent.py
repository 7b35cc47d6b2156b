"""An agent: `--agents linear-bc` clones actions by one linear layer, `id+linear-bc` on a pre-trained encoder."""

from torch import nn

from dmcvb_gen.agents.learners import Policy, register_agent


@register_agent("linear-bc")
class LinearBC(Policy):
    """| W phi(o) - a |^p, averaged over batch and dimensions."""

    options = {"power": 2}  # linear-bc:power=1

    def __init__(self, encoder, sizes, architecture=None, frozen=False, power=2):
        super().__init__()
        self.encoder, self.power = encoder.requires_grad_(not frozen), power
        self.policy = nn.Linear(encoder.features, sizes.action)

    def act(self, observation):
        return self.policy(self.encoder(observation)).clamp(-1, 1)

    def losses(self, batch):
        error = self.policy(self.encoder(batch.observation)) - batch.action
        return {"loss": error.abs().pow(self.power).mean()}
