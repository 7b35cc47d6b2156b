"""Policies that validate keeps: any score of a report can be computed again, and hostile files make no network."""

from __future__ import annotations

import dataclasses
import json

import pytest
from safetensors import safe_open
from safetensors.torch import save_file

import dmcvb_gen
from dmcvb_gen.agents.networks import PATCHES
from dmcvb_gen.benchmarks import trained
from dmcvb_gen.benchmarks.profiles import get_profile
from dmcvb_gen.benchmarks.trained import load_agent
from dmcvb_gen.benchmarks.validate import make_setup, validate
from dmcvb_gen.errors import DmcvbError


def report_of(release, out, agents, only):
    """A report of a few steps whose scores count."""
    profile = dataclasses.replace(get_profile("smoke"), scores=True, network=PATCHES, episodes=3, readout_steps=0)
    setup = dataclasses.replace(make_setup(release, out=out), profile=profile)
    validate(release, setup, agents=agents, patterns=only)
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
        scene = dict(size=agent.sizes.picture) if agent.pixels else {}
        options = dict(episodes=3, max_steps=10, pixels=agent.pixels, stack=agent.stack) | scene
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
    made, untrained = [], trained._untrained

    def watched(*arguments):
        policy = untrained(*arguments)
        made.append(next(policy.parameters()).device.type)
        return policy

    monkeypatch.setattr(trained, "_untrained", watched)
    with pytest.raises(DmcvbError, match="no agent that validate trained"):
        load_agent(tmp_path / "x.safetensors")
    assert "cpu" not in made
    assert load_agent(kept).agent.name == "td3-bc" and made[-2:] == ["meta", "cpu"]
