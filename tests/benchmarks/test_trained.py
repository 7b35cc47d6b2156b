"""Policies that validate keeps: any score of a report can be computed again, and hostile files make no network."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file

import dmcvb_gen
from dmcvb_gen.agents.networks import PATCHES
from dmcvb_gen.benchmarks import evaluate as evaluation
from dmcvb_gen.benchmarks.evaluate import load_agent
from dmcvb_gen.benchmarks.plan import BUDGETS
from dmcvb_gen.benchmarks.validate import validate
from dmcvb_gen.errors import DmcvbError


def report_of(release, out, agents, only):
    """A report of a few steps whose scores count."""
    budget = dataclasses.replace(BUDGETS["smoke"], scores=True, network=PATCHES, episodes=3, readout_steps=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BUDGETS, "smoke", budget)
        validate(release, out=out, agents=agents, only=only, workers=1)
    return out


@pytest.fixture(scope="module")
def walkers(small_release, tmp_path_factory):
    return report_of(small_release, tmp_path_factory.mktemp("walkers"), ["state-bc", "td3-bc"], ["*/*/dynamic"])


@pytest.fixture(scope="module")
def mazes(small_mazes, tmp_path_factory):
    return report_of(small_mazes, tmp_path_factory.mktemp("mazes"), ["state-td3-bc", "id+bc"], ["*/*/visible"])


@pytest.mark.slow
@pytest.mark.parametrize("report", ["walkers", "mazes"])
def test_every_score_of_a_report_is_computed_again_from_its_policy_file(report, request):
    folder = request.getfixturevalue(report)
    results = json.loads((folder / "report.json").read_text())["results"]
    for result in results:
        agent = load_agent(folder / "cells" / f"{result['id']}.safetensors")
        options = dict(episodes=3, max_steps=10)
        where = f"{result['cell']['task']}/{result['cell']['setting']}"
        again = dmcvb_gen.evaluate(agent, where, **options)
        assert list(again.returns) == result["final"]["returns"], result["id"]
        assert dmcvb_gen.evaluate(agent, where, seed=1, **options).returns != again.returns
    assert len(results) == 2


@pytest.mark.parametrize("content", [None, b"not one"])
def test_a_file_that_is_no_agent_is_refused(content, tmp_path):
    path = tmp_path / "x.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DmcvbError, match="no agent that validate trained"):
        load_agent(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [{"sizes": {"action": 10**7}}, {"sizes": {"state": 10**7}}, {"network": {"latent": 10**7}}, "no facts"]
)
def test_a_file_that_names_other_sizes_than_it_holds_makes_no_networks(change, walkers, tmp_path, monkeypatch):
    kept = walkers / "cells" / "b1_walker-walk_dynamic_td3-bc_random.safetensors"
    with safe_open(str(kept), "pt") as file:
        facts = json.loads(file.metadata()["facts"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    changed = [] if change == "no facts" else facts | {key: facts[key] | new for key, new in change.items()}
    save_file(tensors, str(tmp_path / "x.safetensors"), metadata={"facts": json.dumps(changed)})
    made, untrained = [], evaluation._untrained

    def watched(*arguments):
        policy = untrained(*arguments)
        made.append(next(policy.parameters()).device.type)
        return policy

    monkeypatch.setattr(evaluation, "_untrained", watched)
    with pytest.raises(DmcvbError, match="no agent that validate trained"):
        load_agent(tmp_path / "x.safetensors")
    assert "cpu" not in made
    assert load_agent(kept).agent.name == "td3-bc" and made[-2:] == ["meta", "cpu"]


@pytest.mark.slow
def test_an_evaluation_unlike_the_policys_data_is_refused_or_said(walkers, caplog, tmp_path):
    agent = load_agent(walkers / "cells" / "b1_walker-walk_dynamic_td3-bc_random.safetensors")
    options = dict(episodes=2, max_steps=2)
    for wrong, told in (
        (dict(size=32), "size is 32, and the policy learned with 16; leave size out"),
        (dict(stack=1), "stack is 1, and the policy learned with 3; leave stack out"),
        (dict(pixels=False), "pixels is False, and the policy learned with True; leave pixels out"),
    ):
        with pytest.raises(DmcvbError, match=told):
            dmcvb_gen.evaluate(agent, "walker-walk/dynamic", **wrong, **options)
    dmcvb_gen.evaluate(agent, "walker-walk/dynamic", **options)
    assert not caplog.messages
    (tmp_path / "clips" / "val" / "one").mkdir(parents=True)
    Image.fromarray(np.full((8, 8, 3), 200, np.uint8)).save(tmp_path / "clips" / "val" / "one" / "0.png")
    dmcvb_gen.evaluate(agent, "walker-walk/dynamic", backgrounds=str(tmp_path / "clips"), **options)
    drawn = {"renderer": {"name": "opengl", "samples": 4}}
    elsewhere = dataclasses.replace(agent, evaluation=agent.evaluation | drawn)
    dmcvb_gen.evaluate(elsewhere, "walker-walk/dynamic", renderer="native", **options)
    videos, renderer = caplog.messages
    assert "has backgrounds" in videos and "has renderer" in renderer and "opengl" in renderer
