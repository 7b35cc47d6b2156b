"""Agents: sizes as in the paper, gradients where they belong, targets by hand, and each learns what it is shown."""

import contextlib
import dataclasses

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from dmcvb_gen.agents.catalog import agent_names, make_encoder, make_policy, make_pretrainer, parse_agent
from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.dino import DinoEncoder
from dmcvb_gen.agents.laom import LatentActionObservationModel, SupervisedLatentActionObservationModel
from dmcvb_gen.agents.lapo import CODE_WIDTH, LatentActionPolicy
from dmcvb_gen.agents.learners import Batch
from dmcvb_gen.agents.muon import Muon, is_hidden_matrix
from dmcvb_gen.agents.networks import PATCHES, Architecture, FrameDifferences, ObservationDecoder, observation_encoder
from dmcvb_gen.agents.paper import Autoencoder, BehaviorCloning, InverseDynamics, LatentForwardDynamics, StateProbe
from dmcvb_gen.agents.probe import linear_probe
from dmcvb_gen.agents.td3_bc import TD3BC
from dmcvb_gen.agents.trainer import Budget, train
from dmcvb_gen.benchmarks.plan import BUDGETS
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.tasks import ACTION_REPEAT
from tests import independent_td3_bc
from tests.agents.test_agents_data import make_data

SIZE, CHANNELS, ACTIONS, STATES = 16, 9, 6, 24
SIZES, STATE_SIZES = Sizes(STATES, ACTIONS, CHANNELS, SIZE, 3), Sizes(STATES, ACTIONS)


def make_batch(count=8, seed=0, k=1):
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(shape, generator=generator) - 0.5

    return Batch(
        observation=uniform(count, CHANNELS, SIZE, SIZE),
        state=2 * uniform(count, STATES),
        action=1.8 * uniform(count, ACTIONS),
        reward=uniform(count) + 0.5,
        discount=torch.ones(count),
        next_observation=uniform(count, CHANNELS, SIZE, SIZE),
        later_observation=uniform(count, CHANNELS, SIZE, SIZE),
        k=torch.full((count,), k),
    )


def small_encoder(seed=0):
    torch.manual_seed(seed)
    return observation_encoder(CHANNELS, SIZE)


def state_encoder():
    return make_encoder(parse_agent("state-bc"), STATE_SIZES)


def moved(learner, *batches):
    """Names of the parameters that change in an update on each batch."""
    before = {name: value.clone() for name, value in learner.named_parameters()}
    for batch in batches:
        learner.update(batch)
    return {name for name, value in learner.named_parameters() if not torch.equal(before[name], value)}


# -- sizes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [16, 47, 50, 64])
@pytest.mark.parametrize("architecture", [BUDGETS["paper"].network, PATCHES, Architecture((4, 8, 8, 16), (2, 2, 2, 1))])
def test_pictures_of_any_size_are_encoded_and_decoded_to_that_size(size, architecture):
    encoder = observation_encoder(9, size, architecture)
    pictures = torch.zeros(2, 9, size, size)
    assert encoder.body(pictures).shape == (2, encoder.body.features)
    decoder = ObservationDecoder(9, size, encoder.features, architecture)
    assert decoder(encoder(pictures)).shape == pictures.shape


def test_weights_start_orthogonal():
    weight = state_encoder().trunk[0].weight
    torch.testing.assert_close(weight.T @ weight, torch.eye(24), atol=1e-5, rtol=0)


@pytest.mark.parametrize("sample", [False, True])
def test_inverse_dynamics_embeds_k_only_where_it_is_sampled(sample):
    learner = InverseDynamics(small_encoder(), SIZES, k=4, sample=sample)
    near, far = make_batch(k=1), make_batch(k=4)
    same = torch.equal(learner.metrics(near)["loss"], learner.metrics(far)["loss"])
    assert same is not sample


# -- the paper's table of hyperparameters, row by row -----------------------------------------------


def convolutions(module):
    kinds = (torch.nn.Conv2d, torch.nn.ConvTranspose2d)
    layers = [layer for layer in module.modules() if isinstance(layer, kinds)]
    return [(layer.out_channels, layer.kernel_size[0], layer.stride[0]) for layer in layers]


def widths(module):
    return tuple(layer.out_features for layer in module.modules() if isinstance(layer, torch.nn.Linear))


def activations(module):
    """Of the hidden layers and of the output: "relu", "relu", "tanh"; "" if the output has none."""
    kinds = (torch.nn.ReLU, torch.nn.GELU, torch.nn.Tanh)
    layers = [layer for layer in module.modules() if not list(layer.children())]
    found = [type(layer).__name__.lower() for layer in layers if isinstance(layer, kinds)]
    return tuple(found) if isinstance(layers[-1], kinds) else (*found, "")


def test_the_papers_table_of_hyperparameters_holds_row_by_row():
    """Module, hyperparameter -> (the paper's value, ours), appendix "Architecture and hyperparameters".

    Left out is "Actor, Critic 1 and Critic 2: output dimension 64": an actor gives an action, a critic one value.
    """
    paper, budget = Sizes(STATES, ACTIONS, 9, 64, 3), BUDGETS["paper"]
    encoder, by_state, decoder = observation_encoder(9), state_encoder(), ObservationDecoder(9)
    identify, identify_k = (InverseDynamics(encoder, paper, k=k, sample=k > 1) for k in (1, 5))
    trained, predictor = (make_pretrainer(parse_agent(name), encoder, paper) for name in ("id+bc", "state+bc"))
    td3, bc, forward = (make(encoder, paper) for make in (TD3BC, BehaviorCloning, LatentForwardDynamics))
    moved_by_actor = {id(p) for group in td3.optimizers["actor"].param_groups for p in group["params"]}
    rows = {
        ("Observation encoder", "frames"): (3, parse_agent("bc").stack),
        ("Observation encoder", "channels, kernels, strides"): (
            [(32, 3, 2), (64, 3, 2), (128, 3, 1), (256, 3, 1)], convolutions(encoder)
        ),
        ("Observation encoder", "activations"): (("gelu",) * 4 + ("tanh",), activations(encoder)),
        ("Observation encoder", "features, output"): ((65_536, 64), (encoder.body.features, encoder.features)),
        ("Observation encoder", "trunk with its LayerNorm"): (
            65_536 * 64 + 64 + 2 * 64, sum(p.numel() for p in encoder.trunk.parameters())
        ),
        ("State encoder", "input, activation, output"): (
            (STATES, ("tanh",), 64), (by_state.trunk[0].in_features, activations(by_state), by_state.features)
        ),
        ("State predictor layer", "output"): ((STATES,), widths(predictor.h)),
        ("LFD", "decay"): (0.99, forward.decay),
        ("ID", "embedding, steps, sampled"): (
            (64, 1, False), (identify_k.embed_k.out_features, *(trained.draws[name] for name in ("k", "sample_k")))
        ),
        ("TD3-BC", "alpha, discount, frequency, decay"): (
            (2.5, 0.99, 2, 0.99), (td3.alpha, td3.gamma, td3.actor_every, td3.decay)
        ),
        ("TD3-BC", "policy noise, clipping"): ((0.2, 0.5), (td3.noise, td3.noise_clip)),
        ("Observation decoder", "linear layer"): (16 * 16 * 256, decoder.linear.out_features),
        ("Observation decoder", "channels, kernels, strides"): (
            [(128, 3, 1), (64, 3, 1), (32, 3, 2), (9, 3, 2)], convolutions(decoder)
        ),
        ("Observation decoder", "activations"): (("gelu",) * 3 + ("",), activations(decoder)),
        ("Learning", "iterations, batch size"): (
            {400_000, 256}, {budget.pixel_steps, budget.state_steps, budget.batch_size, budget.state_batch_size}
        ),
        ("Learning", "optimizer, rate"): (
            ("Adam", 0.001), (type(bc.optimizers["main"]).__name__, bc.optimizers["main"].defaults["lr"] * budget.rate)
        ),
        ("Online evaluation", "evaluations, runs, action repeat"): (
            (400_000 // 20_000, 30, 2), (budget.evaluations, budget.episodes, ACTION_REPEAT)
        ),
    }  # fmt: skip
    for name, module in (("body", td3.net.body), ("actor", td3.net.actor_trunk), ("critic", td3.net.critic_trunk)):
        moves = {id(p) for p in module.parameters()} <= moved_by_actor
        rows["TD3-BC", f"the actor's loss moves the {name}"] = (True, moves)
    for name, module, kind, outputs in (  # MLPs: two hidden layers of 256 with ReLU, and what they end with
        ("ID action predictor", identify.f, "tanh", ACTIONS),
        ("BC action predictor", bc.policy, "tanh", ACTIONS),
        ("LFD predictor", forward.g, "tanh", 64),
        ("Action encoder", forward.embed_action, "tanh", 64),
        ("State decoder", StateProbe(encoder, paper).h, "", STATES),
        ("Actor", td3.net.actor, "tanh", ACTIONS),
        ("Critic 1", td3.net.critic1, "tanh", 1),
        ("Critic 2", td3.net.critic2, "tanh", 1),
    ):
        rows[name, "hidden layers, output"] = (256, 256, outputs), widths(module)
        rows[name, "activations"] = ("relu", "relu", kind), activations(module)
    assert {row: values for row, values in rows.items() if values[0] != values[1]} == {}


def test_frame_differences_are_those_of_the_pictures():
    """The map on the weights is the same convolution of the newest frame and of successive differences."""
    body = FrameDifferences(9, 8, 4, 4, 0, frames=3)
    pictures = torch.rand(2, 9, 16, 16)
    oldest, middle, newest = pictures.split(3, dim=1)
    by_hand = torch.cat([newest, newest - middle, middle - oldest], dim=1)
    wanted = torch.nn.functional.conv2d(by_hand, body.weight, body.bias, 4)
    torch.testing.assert_close(body(pictures), wanted, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("frozen", ["bc", "td3-bc"])
def test_latents_that_were_encoded_once_teach_the_same_as_pictures(frozen):
    data, policies = make_data(), []
    for encoded in (False, True):
        torch.manual_seed(0)
        encoder = observation_encoder(data.sizes.channels, data.frames.size)
        policy = (BehaviorCloning if frozen == "bc" else TD3BC)(encoder, data.sizes, frozen=True)
        seen = data.encoded(encoder) if encoded else data
        train(policy, seen, Budget("short", batch_size=8, seed=3), 4, shift=False)
        policies.append(policy)
    observation = data.observe(data.train_rows)
    torch.testing.assert_close(*(policy.act(observation) for policy in policies), atol=1e-5, rtol=1e-4)


# -- gradients ------------------------------------------------------------------------------------


def td3(alpha=2.5, sizes=SIZES):
    torch.manual_seed(0)
    learner = TD3BC(None, sizes)
    learner.alpha = alpha
    return learner


KINDS = {
    "bc": (lambda: BehaviorCloning(small_encoder(), SIZES), ("encoder", "policy"), 40, 0.05),
    "bc on states": (lambda: BehaviorCloning(state_encoder(), STATE_SIZES), ("encoder", "policy"), 60, 0.05),
    "frozen bc": (lambda: BehaviorCloning(small_encoder(), SIZES, frozen=True), ("policy",), 60, 0.05),
    "td3-bc": (lambda: td3(alpha=0.01), ("net.critic1", "net.critic2"), 80, 0.1),  # critics first
    "td3-bc on states": (lambda: td3(0.01, STATE_SIZES), ("net.critic1", "net.critic2"), 150, 0.1),
    "id": (lambda: InverseDynamics(small_encoder(), SIZES), ("encoder", "f."), 40, 0.05),
    "sampled id": (
        lambda: InverseDynamics(small_encoder(), SIZES, k=4, sample=True), ("encoder", "f.", "embed_k"), 40, 0.05
    ),
    "lfd": (
        lambda: LatentForwardDynamics(small_encoder(), SIZES), ("encoder", "embed_action", "g.", "target_"), 40, 0.3
    ),
    "ae": (lambda: Autoencoder(small_encoder(), SIZES), ("encoder", "psi"), 60, 0.7),
    "state": (lambda: make_pretrainer(parse_agent("state+bc"), small_encoder(), SIZES), ("encoder", "h."), 60, 0.3),
    "lapo": (lambda: LatentActionPolicy(small_encoder(), SIZES), ("encoder", "see", "f.", "g."), 60, 0.9),
    "laom": (
        lambda: LatentActionObservationModel(small_encoder(), SIZES), ("encoder", "see", "f.", "g.", "target"), 60, 0.3
    ),
    "observation readout": (lambda: Autoencoder(small_encoder().requires_grad_(False), SIZES), ("psi",), 60, 0.7),
    "state readout": (lambda: StateProbe(small_encoder(), SIZES), ("h.",), 80, 0.05),
}  # fmt: skip
"""A learner; the parameters that its first update moves; updates on eight transitions, and what share of the loss is
left after them at most."""


def batch_of(kind):
    batch = make_batch()
    if "on states" in kind:
        return dataclasses.replace(batch, observation=batch.state, next_observation=batch.state)
    return batch


@pytest.mark.parametrize("kind", KINDS)
def test_one_update_moves_exactly_the_parameters_that_the_paper_says(kind):
    make, prefixes, _, _ = KINDS[kind]
    learner = make()
    named = {name for name, _ in learner.named_parameters() if name.startswith(prefixes)}
    assert moved(learner, batch_of(kind)) == named


@pytest.mark.slow_cases("ae", "lapo", "td3-bc")
@pytest.mark.parametrize("kind", KINDS)
def test_each_learner_overfits_eight_transitions(kind):
    make, _, updates, share = KINDS[kind]
    torch.manual_seed(0)
    learner, batch = make(), batch_of(kind)
    before = learner.metrics(batch)["loss"].item()
    for _ in range(updates):
        learner.update(batch)
    assert learner.metrics(batch)["loss"].item() < share * before


def test_td3_bc_on_a_frozen_encoder_leaves_it_alone():
    encoder = small_encoder()
    learner = TD3BC(encoder, SIZES, frozen=True)
    assert learner.target.body is learner.net.body
    changed = moved(learner, *(make_batch(seed=seed) for seed in range(4)))
    assert "net.actor.0.weight" in changed and not any("body" in name for name in changed)


def reached(learner, loss):
    """Parts of a learner that a loss's gradient reaches."""
    learner.zero_grad(set_to_none=True)
    loss.backward(retain_graph=True)
    return {name.split(".")[0] for name, p in learner.named_parameters() if p.grad is not None}


# -- latent actions -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [LatentActionPolicy, LatentActionObservationModel])
def test_latent_actions_learn_from_images_alone_and_the_policy_from_latent_actions(kind):
    learner, batch = kind(small_encoder(), SIZES), make_batch()
    losses = learner.losses(batch)
    assert reached(learner, losses["policy"]) == {"encoder"}
    assert reached(learner, losses["model"]) == {"see", "f", "g"}
    blind = dataclasses.replace(batch, action=batch.action + 9, state=batch.state + 9, reward=batch.reward + 9)
    torch.manual_seed(0)
    learner = kind(small_encoder(), SIZES)
    assert torch.equal(learner.metrics(blind)["loss"], learner.metrics(batch)["loss"])


def test_lapos_latent_actions_are_replaced_by_the_nearest_codes_which_move_to_them():
    learner = LatentActionPolicy(small_encoder(), SIZES)
    learner.codes.fill_(9.0)
    learner.codes[3], learner.codes[5] = 0.5, -0.5
    learner.sums.copy_(learner.codes)
    z = torch.cat([torch.full((1, CODE_WIDTH), 0.4), torch.full((1, CODE_WIDTH), -0.7)], dim=1).requires_grad_()
    with torch.no_grad():
        assert learner.quantize(z)[0].tolist() == [[0.5] * CODE_WIDTH + [-0.5] * CODE_WIDTH]
        assert learner.codes[3, 0] == 0.5  # a test loss moves no code
    codes, distance = learner.quantize(z)
    assert distance.item() == pytest.approx((0.1**2 + 0.2**2) / 2)
    codes.sum().backward()
    assert torch.equal(z.grad, torch.ones_like(z))
    moved = (0.999 * 0.5 + 0.001 * 0.4) / (0.999 + 0.001)
    assert learner.codes[3, 0].item() == pytest.approx(moved) and learner.codes[7, 0].item() == pytest.approx(9.0)


def test_laoms_inverse_model_sees_the_later_observation_and_its_model_the_next_one():
    learner, batch = LatentActionObservationModel(small_encoder(), SIZES), make_batch()
    loss = learner.metrics(batch)["model"]
    other = make_batch(seed=1)
    for name in ("next_observation", "later_observation"):
        assert learner.metrics(dataclasses.replace(batch, **{name: getattr(other, name)}))["model"] != loss
    before = learner.latent_action(batch)
    same = learner.latent_action(dataclasses.replace(batch, later_observation=other.later_observation))
    assert torch.equal(before, same)  # it is labeled by one step
    learner.f.requires_grad_(False).apply(lambda part: [p.zero_() for p in part.parameters(recurse=False)])
    learner.losses(batch)["model"].backward()
    assert not any(p.grad is not None and p.grad.any() for p in learner.see.parameters())  # e learns by f alone


def test_laoms_supervised_variant_learns_from_the_actions_of_labeled_transitions_alone():
    learner, batch = SupervisedLatentActionObservationModel(small_encoder(), SIZES), make_batch()
    labeled = dataclasses.replace(batch, labeled=make_batch(seed=1))
    assert reached(learner, learner.losses(labeled)["labels"]) == {"see", "f", "h"}
    loss, labels = (learner.metrics(labeled)[name] for name in ("loss", "labels"))
    assert learner.metrics(dataclasses.replace(labeled, action=batch.action + 9))["loss"] == loss
    for name, value in (("action", batch.action + 9), ("later_observation", batch.observation)):
        changed = dataclasses.replace(labeled.labeled, **{name: value})
        other = learner.metrics(dataclasses.replace(labeled, labeled=changed))
        assert other["labels"] != labels
        assert (other["loss"] - loss).item() == pytest.approx(0.001 * (other["labels"] - labels).item(), abs=1e-6)
    assert "labels" not in learner.metrics(batch)


def test_a_linear_probe_of_latent_actions_that_know_the_answer():
    generator = torch.Generator().manual_seed(0)
    action, noise = (torch.rand((400, 2), generator=generator) - 0.5 for _ in range(2))
    mixed = torch.cat([action, noise], dim=1) @ torch.randn((4, 4), generator=generator) + 3
    for latent, missed in ((mixed, 0.0), (noise, 1.0), (torch.cat([action[:, :1], noise], dim=1), 0.5)):
        found = linear_probe(latent[:300], action[:300], latent[300:], action[300:])
        assert found == pytest.approx(missed, abs=0.06)
    assert linear_probe(mixed[:300], action[:300], mixed[300:], action[300:] + 1) == pytest.approx(12, rel=0.2)


# -- targets by hand ------------------------------------------------------------------------------


def test_lfds_target_is_an_average_of_the_encoders():
    learner = LatentForwardDynamics(small_encoder(), SIZES)
    first = learner.target_encoder.trunk[0].weight.clone()
    learner.update(make_batch(seed=0))
    after_one = learner.encoder.trunk[0].weight.detach().clone()
    learner.update(make_batch(seed=1))
    after_two = learner.encoder.trunk[0].weight.detach()
    by_hand = 0.99 * (0.99 * first + 0.01 * after_one) + 0.01 * after_two
    torch.testing.assert_close(learner.target_encoder.trunk[0].weight, by_hand, atol=1e-7, rtol=1e-6)


def test_td3_bc_makes_the_steps_of_an_independent_one(monkeypatch):
    """On states, eight steps: the same weights as `tests.independent_td3_bc`, which knows the equations alone."""
    torch.manual_seed(0)
    learner = TD3BC(None, STATE_SIZES)
    weights = {name: value.detach().clone() for name, value in learner.net.named_parameters()}
    batches, goes_on = [], (torch.arange(16) % 3 != 0).float()  # else the episode ended there
    for seed in range(8):
        b = make_batch(16, seed)
        batches.append(dataclasses.replace(b, observation=b.state, next_observation=b.state.flip(0), discount=goes_on))
    drawn = iter(noises := gradients((16, ACTIONS), 8))
    monkeypatch.setattr(torch, "randn_like", lambda like: next(drawn))
    for batch in batches:
        learner.update(batch)
    plain = [(b.observation, b.action, b.reward, b.discount, b.next_observation) for b in batches]
    theirs = independent_td3_bc.train(dict(weights), plain, noises)
    for name, value in learner.net.named_parameters():
        assert not torch.equal(value, weights[name]), name
        torch.testing.assert_close(value.detach(), theirs[name], atol=2e-5, rtol=1e-3, msg=name)


def test_bfloat16_changes_the_precision_and_not_the_meaning():
    learner, batch = BehaviorCloning(small_encoder(), SIZES), make_batch()
    exact = learner.metrics(batch)["loss"]
    learner.half = True
    rough = learner.metrics(batch)["loss"]
    assert rough.dtype == torch.float32 and rough.item() == pytest.approx(exact.item(), rel=0.05)
    assert rough.item() != exact.item()
    learner.update(batch)
    assert all(p.dtype == torch.float32 for p in learner.parameters())


# -- names ----------------------------------------------------------------------------------------


def test_names_of_the_paper_and_options_are_understood():
    assert parse_agent("bc").paper_name == "null+bc" and parse_agent("state-bc").paper_name == "bc(state)"
    agent = parse_agent("id+bc:frames=1:k=5:sample")
    assert (agent.stack, agent.options) == (1, (("k", 5), ("sample", True)))
    assert parse_agent(agent.name) == agent and agent.paper_name == agent.name


@pytest.mark.parametrize("name", ["idd+bc", "id+", "bc+id", ""])
def test_an_unknown_agent_is_refused_with_the_known_ones(name):
    with pytest.raises(UnknownNameError, match="id\\+bc"):
        parse_agent(name)


@pytest.mark.parametrize("name, takes", [
    ("bc:frames=0", "frames=1..64"), ("bc:depth=3", "frames=1..64"), ("id+bc:k=x", "frames=1..64, k=1..64, sample"),
    ("id+bc:sample=3", "frames=1..64, k=1..64, sample"), ("lfd+bc:k=10:sample", "frames=1..64"),
    ("state-bc:frames=1", "none"), ("td3-bc:k=5", "frames=1..64"),
])  # fmt: skip
def test_an_option_that_an_agent_does_not_know_is_refused_with_those_that_it_takes(name, takes):
    with pytest.raises(DmcvbError, match=f"is not an option of agent .*; it takes {takes}$"):
        parse_agent(name)


# -- DINO -----------------------------------------------------------------------------------------


def test_dino_gives_every_picture_of_a_stack_its_token_and_never_learns(tmp_path):
    """A tiny network of timm's class with random weights, in a file as timm's.

    A torchvision of another build than torch lacks these two operators, which nothing here calls.
    """
    operators = torch.library.Library("torchvision", "FRAGMENT")
    for name in ("nms", "qnms"):
        with contextlib.suppress(RuntimeError):  # it is there
            operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    transformers = pytest.importorskip("timm.models.vision_transformer")
    torch.manual_seed(0)
    sizes = dict(img_size=224, patch_size=16, embed_dim=64, depth=2, num_heads=1, mlp_ratio=2, num_classes=3)
    dino_file = tmp_path / "dino.safetensors"
    save_file(transformers.VisionTransformer(**sizes).state_dict(), str(dino_file))
    encoder = DinoEncoder.load(dino_file, channels=9)
    observation = torch.rand(2, 9, 64, 64) - 0.5
    features = encoder(observation)
    assert features.shape == (2, 3 * 64) and encoder.features == 3 * 64
    alone = DinoEncoder.load(dino_file, channels=3)(observation[:, 3:6])
    torch.testing.assert_close(features[:, 64:128], alone, atol=1e-5, rtol=1e-5)
    learner = BehaviorCloning(encoder, SIZES, frozen=True)
    assert not any(p.requires_grad for p in encoder.parameters())
    assert learner.act(observation).shape == (2, ACTIONS)


def test_a_file_that_is_no_dino_is_refused(tmp_path):
    save_file({"x": torch.zeros(1)}, str(tmp_path / "x.safetensors"))
    with pytest.raises(DmcvbError, match="does not hold"):
        DinoEncoder.load(tmp_path / "x.safetensors", channels=9)
    (tmp_path / "y.safetensors").write_bytes(b"not one")
    with pytest.raises(DmcvbError, match="does not hold"):
        DinoEncoder.load(tmp_path / "y.safetensors", channels=9)
    torch.save({"x": torch.zeros(1)}, tmp_path / "z.pth")
    with pytest.raises(DmcvbError, match="is no .safetensors file"):
        DinoEncoder.load(tmp_path / "z.pth", channels=9)


@pytest.mark.parametrize("name", [name for name in agent_names() if not name.startswith("dino")])
def test_every_agent_can_be_made_and_acts(name):
    agent, data = parse_agent(name), make_data()
    assert agent.name == name
    data = data.but(frames=None) if agent.sees_state else data
    encoder = make_encoder(agent, data.sizes)
    if agent.pretrain:
        make_pretrainer(agent, encoder, data.sizes)
    policy = make_policy(agent, encoder, data.sizes)
    action = policy.act(data.observe(data.train_rows[:3]))
    assert action.shape == (3, 2) and action.abs().max() <= 1
    assert policy.encoder.features == 64


# -- Muon beside torch's own and beside Adam --------------------------------------------------------


def gradients(shape: tuple[int, ...], count: int = 6) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(shape, generator=generator) for _ in range(count)]


def descend(optimizer: torch.optim.Optimizer, weight: nn.Parameter, steps: list[torch.Tensor]) -> torch.Tensor:
    for gradient in steps:
        weight.grad = gradient.clone()
        optimizer.step()
    return weight.detach()


@pytest.mark.parametrize("shape", [(48, 96), (96, 48), (64, 64)])
def test_matrices_move_as_by_torchs_muon(shape):
    start, steps = torch.randn(shape, generator=torch.Generator().manual_seed(0)), gradients(shape)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    half = descend(Muon([ours], 0.01, torch.bfloat16), ours, steps)
    torchs = torch.optim.Muon([theirs], lr=0.01, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    expected = descend(torchs, theirs, steps)
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
