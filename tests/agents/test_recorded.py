"""Recorded updates give the weights of updates in turn: on a GPU, or here with a graph that calls what it recorded."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from dmcvb_gen.agents import recorded, trainer
from dmcvb_gen.agents.bc import BehaviorCloning
from dmcvb_gen.agents.catalog import make_policy, make_pretrainer, parse_agent
from dmcvb_gen.agents.data import HeldFrames, Normalization
from dmcvb_gen.agents.networks import Architecture, observation_encoder, state_encoder
from dmcvb_gen.agents.trainer import TrainSettings, train
from tests.agents.test_agents_data import SIZE, make_data

SMALL = Architecture((32, 32), (4, 2), "relu", patch=True, differences=True, latent=32)
ON_GPU = torch.cuda.is_available()


class Calls:
    """In place of a CUDA graph: calls what was asked for while it recorded."""

    def replay(self):
        self.update()


@pytest.fixture
def data(monkeypatch):
    data = make_data()
    if ON_GPU:
        frames = HeldFrames(data.frames.table.numpy(), "cuda")
        move = {name: value.cuda() for name, value in vars(data).items() if torch.is_tensor(value)}
        normal = Normalization(data.normalization.mean.cuda(), data.normalization.std.cuda())
        return data._with(frames=frames, normalization=normal, **move)
    monkeypatch.setattr(torch.cuda, "Event", lambda: SimpleNamespace(synchronize=int, record=int))
    zeros = torch.zeros
    monkeypatch.setattr(torch, "zeros", lambda *args, pin_memory=False, **rest: zeros(*args, **rest))
    monkeypatch.setattr(recorded.RecordedUpdate, "_warm_up", recorded.RecordedUpdate._update)

    def record(self):
        self._graph = Calls()
        self._graph.update = self._update
        self._graph.replay()

    monkeypatch.setattr(recorded.RecordedUpdate, "_record", record)
    monkeypatch.setattr(trainer, "can_record", lambda learner, data: learner.recordable)
    return data


def bc(data):
    return BehaviorCloning(observation_encoder(data.channels, SIZE, SMALL, data.stack), data.sizes, SMALL)


def by_state(data):
    return BehaviorCloning(state_encoder(data.state.shape[1]), data.sizes)


def pretrainer(name):
    def make(data):
        encoder = observation_encoder(data.channels, SIZE, SMALL, data.stack)
        return make_pretrainer(parse_agent(name), encoder, data.sizes, SMALL)

    return make


def privileged(data):
    encoder = observation_encoder(data.channels, SIZE, SMALL, data.stack)
    return make_policy(parse_agent("privileged-bc"), encoder, data.sizes, SMALL)


LEARNERS = {"bc": bc, "by state": by_state, "privileged bc": privileged}
LEARNERS |= {name: pretrainer(name) for name in ("id+bc", "id+bc:k=2,sample", "lfd+bc", "ae+bc", "state+bc")}
SETTINGS = TrainSettings(steps=12, batch_size=8, evaluate_every=6, points=3, half=False, rate=0.1)


def trained(name, data, settings):
    data = data.states_only() if name == "by state" else data
    torch.manual_seed(0)
    learner = LEARNERS[name](data).to(data.device)
    curve = train(learner, data, settings, seed=5)
    return learner, [{key: value for key, value in point.items() if key != "seconds"} for point in curve]


@pytest.mark.parametrize("changed", [{}, {"muon": True, "decay": True, "shift": False}], ids=["paper", "quick"])
@pytest.mark.parametrize("name", LEARNERS)
def test_a_recorded_update_teaches_what_an_update_in_turn_does(name, changed, data):
    settings = dataclasses.replace(SETTINGS, **changed)
    (one, curve), (two, wanted) = (
        trained(name, data, dataclasses.replace(settings, record=record)) for record in (True, False)
    )
    tolerance = {"atol": 1e-3, "rtol": 1e-2} if ON_GPU else {"atol": 1e-6, "rtol": 1e-5}
    for weight, other in zip(one.state_dict().values(), two.state_dict().values(), strict=True):
        torch.testing.assert_close(weight, other, **tolerance)
    for point, other in zip(curve, wanted, strict=True):
        assert point == pytest.approx(other, rel=2e-2 if ON_GPU else 1e-4)


def test_nothing_is_recorded_without_a_gpu_or_from_a_mapped_file():
    data = make_data()
    assert not recorded.can_record(bc(data), data)
    on_gpu = SimpleNamespace(device=torch.device("cuda"), frames=SimpleNamespace(mapped=False))
    assert recorded.can_record(bc(data), on_gpu)
    derived = type("Derived", (BehaviorCloning,), {})(observation_encoder(9, SIZE, SMALL), data.sizes, SMALL)
    assert not recorded.can_record(derived, on_gpu)  # its class does not say that its updates are alike
    on_gpu.frames.mapped = True
    assert not recorded.can_record(bc(data), on_gpu)


def test_an_agent_whose_updates_differ_is_not_recorded():
    assert not make_policy(parse_agent("td3-bc"), None, make_data().sizes, SMALL).recordable
