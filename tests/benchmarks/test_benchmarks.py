"""Benchmarks: the right cells for a release, the paper's numbers, online episodes as the task gives them."""

import copy
import dataclasses
import importlib
import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from dmcvb_gen import own_code
from dmcvb_gen.agents.catalog import make_encoder, make_policy, parse_agent
from dmcvb_gen.agents.data import Normalization, Slice, choose_episodes, labeled_episodes, load_data, normalize_pixels
from dmcvb_gen.agents.learners import PARTS
from dmcvb_gen.agents.networks import PATCHES
from dmcvb_gen.agents.paper import Autoencoder, StateProbe
from dmcvb_gen.agents.trainer import train
from dmcvb_gen.benchmarks import cell as cells_module
from dmcvb_gen.benchmarks.cell import CellRun, fingerprint, planned_steps, run_cells
from dmcvb_gen.benchmarks.evaluate import Evaluator, TrainedAgent
from dmcvb_gen.benchmarks.plan import BENCHMARKS, BUDGETS, Cell, paper_score, plan_benchmark
from dmcvb_gen.benchmarks.report import _groups, compare, comparison
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import ShardRecord
from dmcvb_gen.distractors import DistractorSampler
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.resolve import resolve
from dmcvb_gen.parallel import Needs, Ray, SerialPool
from dmcvb_gen.parallel.ray_pool import share_of_node
from dmcvb_gen.storage.store import open_store
from dmcvb_gen.tasks import get_task
from tests.conftest import small_recipe
from tests.distractors.test_backgrounds import write_frames

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples" / "extending"


def release_of(*names, episodes=100, committed=None, **goals):
    """A release of subsets without data, enough to plan with; its shards of ten are committed, or the first few."""
    subsets = []
    for name in names:
        task, level, setting = name.split("/")
        counts = goals if setting == "fixed" else {"episodes": episodes}
        subsets.append({"tasks": task, "levels": level, "settings": setting, "episodes_per_shard": 10} | counts)
    resolved = resolve(small_recipe(subsets=subsets), pixels=False).resolved
    release = Release(open_store("nowhere"), resolved, None, False, None)
    for layer in resolved.layers:
        shards = range((committed or episodes) // 10)
        release._records[layer.name] = {n: ShardRecord(key=layer.job_key(n), files={}) for n in shards}
    return release


WALKER = [f"walker-walk/{level}/{s}" for level in ("expert", "medium", "mixed", "random") for s in ("none", "dynamic")]


def planned(benchmark, *names, agents=(), **facts):
    """(agent, policy's data, encoder's data, setting) of every cell, and the subsets that are missing."""
    cells, missing = plan_benchmark(benchmark, release_of(*names, **facts), agents)
    assert len({cell.id for cell in cells}) == len(cells)
    found = {(cell.agent.name, cell.policy_label, cell.pretrain_label, cell.setting) for cell in cells}
    return found, {name for one in missing for name in one.subsets}


def test_cells_whose_encoders_learned_under_other_settings_have_other_names():
    parts = [(Slice(f"walker-walk/random/{setting}"),) for setting in ("none", "dynamic")]
    cells = [Cell("b1", "walker-walk", "none", parse_agent("id+bc"), parts[0], part) for part in parts]
    cells += [Cell("b1", "walker-walk", "none", parse_agent("bc"), part) for part in parts]
    assert len({cell.id for cell in cells}) == 4


def test_b1_has_every_agent_on_every_set_and_states_once():
    found, missing = planned("b1", *WALKER)
    levels = ("expert", "medium", "mixed", "random", "expert+medium")
    seeing = ("bc", "td3-bc", "id+bc", "lfd+bc", "ae+bc", "state+bc")
    by_state = {("state-bc", level, "", "none") for level in levels}
    by_sight = {(agent, level, "", s) for agent in seeing for level in levels for s in ("none", "dynamic")}
    assert found == by_state | by_sight
    assert missing == {f"walker-walk/{level}/static" for level in ("expert", "medium", "mixed", "random")}


def test_b2_learns_encoders_from_mixed_and_policies_from_twenty_expert_episodes():
    found, missing = planned("b2", *WALKER)
    assert not missing and found == {("bc", "expert", "", "none")} | {
        cell
        for setting in ("none", "dynamic")
        for cell in (
            *(("bc", policy, "", setting) for policy in ("20 expert", "20 expert+mixed")),
            *((f"{encoder}+bc", "20 expert", "mixed", setting) for encoder in ("id", "bc", "lfd", "ae")),
        )
    }
    few, _ = planned("b2", "walker-walk/expert/none", "walker-walk/mixed/none", episodes=10)
    assert {policy for _, policy, _, _ in few} == {"expert", "10 expert", "10 expert+mixed"}  # as many as there are
    found, missing = planned("b2", "walker-walk/expert/none")
    assert {policy for _, policy, _, _ in found} == {"expert", "20 expert"} and missing == {"walker-walk/mixed/none"}
    found, _ = planned("b2", *WALKER, agents=["dino+bc"])  # whose encoder learned elsewhere
    assert {cell[1:3] for cell in found if cell[0] == "dino+bc"} == {("20 expert", "")}


MAZE = "ant-maze-empty7x7"


FIXED = (f"{MAZE}/expert/hidden", f"{MAZE}/expert/fixed")


@pytest.mark.parametrize("per_goal, committed, pairs", [(10, 50, range(5)), (20, 100, range(5)), (20, 50, range(2))])
def test_b3_has_a_policy_for_each_fixed_goal_whose_episodes_are_all_there(per_goal, committed, pairs):
    facts = dict(fixed_goals=5, episodes_per_goal=per_goal, episodes=5 * per_goal, committed=committed)
    found, missing = planned("b3", *FIXED, **facts)
    agents = (("bc", ""), ("bc+bc", "expert, hidden"), ("id+bc", "expert, hidden"))
    assert not missing
    assert found == {(agent, f"expert goal {pair}", data, "fixed") for pair in pairs for agent, data in agents}


@pytest.mark.parametrize("episodes, budgets", [(200, (2, 8, 32, 128)), (30, (2, 8)), (134, (2, 8, 32))])
@pytest.mark.parametrize("name", ["walker-walk/expert/dynamic", f"{MAZE}/expert/visible"])
def test_b4_decodes_latent_actions_by_each_label_budget_beside_bc_on_it_and_on_all(name, episodes, budgets):
    found, missing = planned("b4", name, episodes=episodes)
    latent = (("lapo+bc", "expert"), ("laom+bc", "expert"), ("laom-labels+bc", "expert"))
    setting, agents = name.split("/")[-1], (("bc", ""), *latent)
    few = {(agent, f"{budget} expert", data, setting) for budget in budgets for agent, data in agents}
    assert found == few | {("bc", "expert", "", setting)} and not missing
    cells, _ = plan_benchmark("b4", release_of(name, episodes=episodes), [])
    encoders = {agent: {cell.encoder for cell in cells if cell.agent.name == agent} for agent, _ in latent}
    assert {agent: len(found) for agent, found in encoders.items()} == {
        "lapo+bc": 1, "laom+bc": 1, "laom-labels+bc": len(budgets)
    }  # fmt: skip


def test_a_smaller_label_budget_is_a_part_of_a_larger_one_and_hangs_on_the_seed():
    subset = release_of("walker-walk/expert/none", episodes=200)["walker-walk/expert/none"]
    drawn = {}
    for seed in (0, 1):
        for budget in (2, 8, 32, 128):
            episodes, held_out = choose_episodes(subset, Slice(subset.name, episodes=budget), seed)
            drawn[seed, budget] = set(episodes.tolist())
            assert len(drawn[seed, budget]) == budget and not held_out.any()
        everything, held_out = choose_episodes(subset, Slice(subset.name), seed)
        assert held_out.sum() == 10 and drawn[seed, 128].isdisjoint(everything[held_out])  # whose images are learned
        assert drawn[seed, 2] < drawn[seed, 8] < drawn[seed, 32] < drawn[seed, 128]
    assert drawn[0, 8] != drawn[1, 8]


@pytest.mark.parametrize("benchmark, names", [("b2", WALKER), ("b3", FIXED)])
def test_labels_of_other_subsets_than_the_encoders_are_refused(benchmark, names):
    with pytest.raises(DmcvbError, match=f"{benchmark}: agent laom-labels.bc learns from labels .* --benchmark b4"):
        planned(benchmark, *names, agents=["id+bc", "laom-labels+bc"], fixed_goals=5, episodes_per_goal=20)


def test_episodes_are_labeled_by_subset_and_number_and_held_out_ones_are_not():
    release = release_of("walker-walk/expert/none", "walker-walk/medium/none", episodes=20)
    expert, medium = map(Slice, release.subsets)
    chosen, held_out = choose_episodes(release[expert.subset], expert, 0)
    few = choose_episodes(release[expert.subset], Slice(expert.subset, episodes=2), 0)[0]
    for labels, wanted in (
        ([expert, medium], [*~held_out, *~held_out]),
        ([Slice(expert.subset, episodes=2)], [*np.isin(chosen, few), *[False] * 20]),
    ):
        np.testing.assert_array_equal(labeled_episodes(release, [expert, medium], labels, 0), wanted)


def test_mazes_have_the_papers_two_levels_in_b1_and_others_where_they_are_there():
    found, missing = planned("b1", f"{MAZE}/expert/visible", f"{MAZE}/random/visible", agents=["bc"])
    assert {policy for _, policy, _, _ in found} == {"expert", "random"} and missing == {f"{MAZE}/medium/visible"}


def test_the_papers_scores_are_those_of_its_table():
    assert paper_score("walker-walk", "expert", "dynamic", "null+bc") == (913, 10)
    assert paper_score("humanoid-walk", "expert+medium", "static", "bc(state)") == (585, 21)
    assert paper_score("walker-walk", "expert", "dynamic_hard", "null+bc") is None
    for name in ("state-td3-bc", "bc:frames=1", "lapo+bc"):
        assert paper_score("walker-walk", "expert", "none", parse_agent(name).paper_name) is None


def test_a_scaled_profile_says_so():
    half = BUDGETS["quick"].scaled(0.5)
    assert half.pixel_steps == BUDGETS["quick"].pixel_steps / 2 and "x0.5" in half.name and "0.5 times" in half.note


def test_a_cell_is_read_back_from_its_facts():
    goals = dict(fixed_goals=5, episodes_per_goal=10, episodes=50)
    for release in (release_of(*WALKER), release_of(f"{MAZE}/expert/hidden", f"{MAZE}/expert/fixed", **goals)):
        for name in BENCHMARKS.all():
            for cell in plan_benchmark(name, release)[0]:
                assert Cell.of(json.loads(json.dumps(cell.facts()))) == cell


# -- online evaluation ----------------------------------------------------------------------------


def test_scores_are_the_tasks_rewards_and_states_are_normalized(small_release):
    subset = Release.open(small_release)["walker-walk/random/none"]
    normalization = Normalization(torch.full((24,), 0.5), torch.full((24,), 2.0))
    evaluator = Evaluator(subset, pixels=False, episodes=3, max_steps=6)
    agent, seen = parse_agent("state-bc"), []
    sizes = load_data(subset.release, [Slice(subset.name)], pixels=False).sizes
    policy = make_policy(agent, make_encoder(agent, sizes), sizes)
    policy.act = lambda states: seen.append(states.clone()) or torch.full((len(states), 6), 0.1)
    score = evaluator.score(TrainedAgent(agent, sizes, policy, normalization))
    batch, returns = evaluator.task.batch(3), np.zeros(3)
    states = [batch.reset(evaluator.streams("initial_state"))]
    for _ in range(6):
        result = batch.step(np.full((3, 6), 0.1))
        returns += result.reward
        states.append(result.state)
    np.testing.assert_allclose(score.returns, returns, rtol=1e-6)
    assert score.stderr == pytest.approx(returns.std(ddof=1) / np.sqrt(3))
    np.testing.assert_allclose(seen[4], (states[4] - 0.5) / 2, rtol=1e-5, atol=1e-5)
    assert score.success is None and score.pictures is None


def test_an_agent_is_shown_in_evaluation_what_it_is_shown_in_training(small_release):
    subset = Release.open(small_release)["walker-walk/random/none"]
    data = load_data({subset.name: subset}, [Slice(subset.name)])
    evaluator = Evaluator(subset, episodes=3, max_steps=4)
    streams = {name: evaluator.streams(name) for name in ("camera", "color", "background", "style")}
    walk = DistractorSampler(evaluator.task, evaluator.setting, 5, streams, None, split="val")
    physics, stack = subset.read("physics"), None
    for step in range(4):
        stack = evaluator._see(stack, physics[:, step], walk, step, np.ones(3, bool))
        shown = normalize_pixels(torch.from_numpy(stack).flatten(1, 2))
        rows = torch.arange(3) * 501 + step
        assert torch.equal(shown, data.observe(rows))
    evaluator.close()


def test_evaluation_episodes_are_no_releases_episodes(small_release):
    subset = Release.open(small_release)["walker-walk/random/none"]
    evaluator = Evaluator(subset, pixels=False, episodes=8)
    first = evaluator.task.batch(8).reset(evaluator.streams("initial_state"))
    stored = subset.read("state")[:, 0]
    assert np.abs(first[:, None] - stored[None]).max(axis=2).min() > 1e-3


def test_mazes_are_scored_by_success_and_start_where_the_pair_says():
    name, task, seen = f"{MAZE}/expert/fixed", get_task(MAZE), []
    subset = release_of(name, fixed_goals=5, episodes_per_goal=20)[name]
    evaluator = Evaluator(subset, pixels=False, episodes=2, max_steps=3, pair=((1, 1), (5, 5)))
    score = evaluator.score(lambda observation: seen.append(observation["state"]) or np.full((2, 8), 0.1))
    assert score.success == 0.0 and score.speed is None and score.mean < 0
    place = seen[0][:, task.state_slices["walker_position"]]
    assert np.abs(place[:, :2] - task.layout.world((1, 1))).max() <= 0.25 + 1e-5 and (place[0] != place[1]).any()


# -- running cells --------------------------------------------------------------------------------

SMOKE = BUDGETS["smoke"]


@pytest.mark.slow
def test_processes_train_each_encoder_before_its_cells(small_release, tmp_path):
    cells = [c for c in plan_benchmark("b1", Release.open(small_release), ["state-bc", "id+bc"])[0]]
    cells = [c for c in cells if c.setting in ("none", "static") and c.policy_label == cells[0].policy_label]
    steps = []

    def run(workers):
        out = tmp_path / str(workers)
        return dict(run_cells(small_release, out, SMOKE, cells, workers, lambda _, made: steps.append(made)))

    results, alone = run(2), run(1)
    assert len({cell.encoder for cell in cells} - {None}) == 2 and results.keys() == set(cells)
    for cell, result in results.items():
        assert result["score"]["returns"] == pytest.approx(alone[cell]["score"]["returns"])
        if cell.encoder:
            trained = (tmp_path / "2" / "encoders" / f"{cell.encoder.id}.json").stat().st_mtime_ns
            assert trained < (tmp_path / "2" / "cells" / f"{cell.id}.json").stat().st_mtime_ns
    assert sum(steps) == 2 * planned_steps(SMOKE, cells)


def test_a_result_of_another_seed_is_not_taken_for_this_one(small_release, tmp_path):
    cells = plan_benchmark("b1", Release.open(small_release), ["state-bc"])[0][:1]
    made = []
    for seed in (0, 0, 1):
        steps, budget = [], dataclasses.replace(SMOKE, seed=seed)
        list(run_cells(small_release, tmp_path, budget, cells, tick=lambda _, count, steps=steps: steps.append(count)))
        made.append(sum(steps))
    assert made == [3, 0, 3]


def test_what_a_score_hangs_on_besides_the_data_is_in_its_fingerprint(small_release, tmp_path):
    """A row for each change: which agents' cells are other ones then."""
    release, weights = Release.open(small_release), tmp_path / "dino.safetensors"
    cells = {c.agent.name: c for c in plan_benchmark("b1", release, ["dino+bc", "id+bc", "bc", "state-bc"])[0]}
    cells |= {"encoder": cells["id+bc"].encoder}
    write_frames(tmp_path / "clips" / "val" / "one", [np.full((8, 8, 3), 200, np.uint8)], "png")
    save_file({"x": torch.zeros(1)}, str(weights))
    save_file({"x": torch.ones(1)}, str(tmp_path / "other.safetensors"))
    plain = dataclasses.replace(SMOKE, dino_weights=str(weights))
    before = {name: fingerprint(release, plain, cell) for name, cell in cells.items()}
    everything, seeing = set(cells), {"dino+bc", "id+bc", "bc"}
    for change, expected in (
        ({"backgrounds": str(tmp_path / "clips")}, seeing),  # states show no videos
        ({"dino_weights": str(tmp_path / "other.safetensors")}, {"dino+bc"}),
        ({"precision": "bfloat16"}, seeing | {"encoder"}),
        ({"seed": 1}, everything),
        ({"rate": 2.0}, everything),
        ({"threads": 7, "note": "x", "memory": 5, "compile": True}, set()),
    ):
        budget = dataclasses.replace(plain, **change)
        found = {name for name, cell in cells.items() if fingerprint(release, budget, cell) != before[name]}
        assert found == expected, change


def test_an_agent_of_another_package_that_changed_is_another_one(small_release, tmp_path, monkeypatch):
    release, file = Release.open(small_release), tmp_path / "theirs.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(PARTS, "_things", dict(PARTS.all()))
    monkeypatch.setattr(PARTS, "_code", dict(PARTS._code))
    file.write_text((EXAMPLES / "agent.py").read_text().replace("linear-bc", "their-bc"))
    importlib.import_module("theirs")
    cells = {cell.agent.name: cell for cell in plan_benchmark("b1", release, ["their-bc", "bc"])[0]}
    before = {name: fingerprint(release, SMOKE, cell) for name, cell in cells.items()}
    file.write_text(file.read_text() + "\n# changed\n")
    with pytest.raises(DmcvbError, match="old code still runs; restart Python"):
        fingerprint(release, SMOKE, cells["their-bc"])
    own_code._digests.clear()  # as in a new process
    after = {name: fingerprint(release, SMOKE, cell) for name, cell in cells.items()}
    assert before["their-bc"] != after["their-bc"] and before["bc"] == after["bc"]


SHARES_OF_MEMORY = [
    (4, {"memory": 1000}, 250),
    (Ray("nowhere:1"), {}, 2_000_000),
    (Ray("nowhere:1"), {"memory": 1000}, 1000),
    (Ray("nowhere:1"), {"device": "cuda"}, None),  # a cell has a GPU, and its memory, alone
]


@pytest.mark.parametrize("workers, change, expected", SHARES_OF_MEMORY)
def test_cells_take_no_more_memory_than_their_share(small_release, tmp_path, monkeypatch, workers, change, expected):
    held = []
    if isinstance(workers, Ray):
        monkeypatch.setattr(SerialPool, "memory_each", lambda pool: 4_000_000)
    monkeypatch.setattr(cells_module, "open_pool", lambda *_, **__: SerialPool())
    monkeypatch.setattr(cells_module, "try_cell", lambda *given, tick=None: held.append(given[2].memory) or {})
    cells = plan_benchmark("b1", Release.open(small_release), ["state-bc"])[0][:1]
    list(run_cells(small_release, tmp_path, dataclasses.replace(SMOKE, **change), cells, workers))
    assert held == [expected]


def test_a_node_is_shared_by_the_cells_that_fit_on_it():
    nodes = [
        {"Alive": True, "Resources": {"CPU": 8.0, "memory": 8e9, "GPU": 2.0}},
        {"Alive": True, "Resources": {"CPU": 5.0, "memory": 1e10}},
        {"Alive": True, "Resources": {"CPU": 1.0, "memory": 1e6}},  # too few cores for two
        {"Alive": False, "Resources": {}},
    ]
    assert share_of_node(nodes, Needs(cpus=2)) == 2e9
    assert share_of_node(nodes, Needs(cpus=2, gpus=1)) == 4e9
    assert share_of_node(nodes, Needs(cpus=16)) is None


@pytest.mark.slow
@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
def test_an_inspection_says_what_it_does_and_needs_no_kept_latents(whole, request, tmp_path, monkeypatch):
    folder, found = request.getfixturevalue(whole), []
    cell = plan_benchmark("b1", Release.open(folder), ["bc"])[0][0]
    budget, original = dataclasses.replace(SMOKE, frozen_shift=False), CellRun._encoded
    for draws in (0, 10**9):
        told = []
        monkeypatch.setattr(CellRun, "_encoded", lambda *given, draws=draws: original(*given[:3], draws))
        run = CellRun(folder, tmp_path / str(draws), budget, cell, lambda *tick, told=told: told.append(tick))
        found.append(run.result()["inspection"])
        assert sum(steps for _, steps in told) == planned_steps(budget, [cell])
        assert ("encoding, 100%" in {what for what, _ in told}) == bool(draws)
    for name in ("observation_mse", "state_mse"):
        assert found[0][name] == pytest.approx(found[1][name], rel=1e-3)


@pytest.mark.slow_cases("maze_release")
@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
def test_test_errors_of_decoders_that_say_nothing_are_the_spread_of_the_data(whole, request, tmp_path):
    release = Release.open(request.getfixturevalue(whole))
    run = CellRun(release.path, tmp_path, SMOKE, plan_benchmark("b1", release, ["bc"])[0][0])
    data, network = run.data(), SMOKE.network
    encoder = make_encoder(run.cell.agent, data.sizes, None, network)
    seen = data.transitions(data.hold_out_rows)
    assert len(data.hold_out_rows)
    for probe, values in (
        (Autoencoder(encoder, data.sizes, network), seen.observation),
        (StateProbe(encoder, data.sizes), seen.state),
    ):
        for weights in probe.parameters():
            weights.data.zero_()
        assert cells_module.test_error(probe, data, 64) == pytest.approx(float(values.square().mean()), rel=1e-5)


def test_any_error_of_a_cell_is_its_own_with_its_traceback_in_a_log(small_release, tmp_path, monkeypatch):
    release, budget = Release.open(small_release), dataclasses.replace(SMOKE, seed=7)  # data that are not loaded yet
    cells = [c for c in plan_benchmark("b1", release, ["dino+bc", "state-bc"])[0] if c.setting == "none"]
    monkeypatch.setattr(cells_module, "load_data", Mock(side_effect=MemoryError("no room for 7 GB")))
    results = {cell.agent.name: result for cell, result in run_cells(small_release, tmp_path, budget, cells)}
    log = tmp_path / "cells" / f"{cells[1].id}.log"
    assert results["state-bc"]["error"] == f"MemoryError: no room for 7 GB (all of it in {log})"
    assert " load_data(" in log.read_text() and "--dino-weights" in results["dino+bc"]["error"]
    monkeypatch.setattr(cells_module, "write_text", Mock(side_effect=OSError("no space left")))
    results = {cell.agent.name: result for cell, result in run_cells(small_release, tmp_path, budget, cells)}
    assert results["state-bc"]["error"].startswith("MemoryError")
    monkeypatch.undo()
    results = {cell.agent.name: result for cell, result in run_cells(small_release, tmp_path, budget, cells)}
    assert results["state-bc"]["score"]["mean"] >= 0 and not log.exists()


@pytest.mark.parametrize("benchmark, task, setting, reference, agent, share, difference, words", [
    ("b1", MAZE, "x", ("state-bc", -40.0), ("bc", -800.0), None, -760.0, "BC(state)"),
    ("b1", "walker-walk", "x", ("state-bc", 800.0), ("bc", 400.0), 0.5, -400.0, "BC(state)"),
    ("b4", "walker-walk", "x", ("bc", 800.0), ("lapo+bc", 200.0), 0.25, -600.0, "BC on all labels"),
    ("b3", MAZE, "x", ("bc", -60.0), ("id+bc", -45.0), None, 15.0, "BC on these episodes"),
    ("b2", "walker-walk", "none", ("bc", 8.0), ("bc:frames=1", 4.0), 0.5, -4.0, "BC on all of expert/none"),
])  # fmt: skip
def test_a_score_is_a_share_of_its_reference_or_a_difference_if_returns_are_negative(
    benchmark, task, setting, reference, agent, share, difference, words
):
    results, part = [], (Slice(f"{task}/expert/{setting}"),)
    for name, mean in (reference, agent):
        results.append((Cell(benchmark, task, setting, parse_agent(name), part), {"score": {"mean": mean}}))
    assert compare(results[1][0], results) == {"share": share, "difference": difference, "reference": words}


def test_data_that_grew_or_look_otherwise_are_read_again(small_release, tmp_path):
    release = Release.open(small_release)
    cell = plan_benchmark("b1", release, ["state-bc"])[0][0]
    subset = release[cell.policy[0].subset]
    less = copy.copy(release)
    less._here = {layer.name: frozenset({0}) for layer in subset.layers}

    def data_of(release, budget=SMOKE):
        run = CellRun(small_release, tmp_path, budget, cell)
        run.release = release
        return run.data(pixels=False)

    found = [data_of(one) for one in (less, less, release, release)]
    assert [len(data.lengths) for data in found] == [2, 2, 3, 3]
    assert found[0] is found[1] and found[2] is found[3]
    assert data_of(release, dataclasses.replace(SMOKE, memory=10**9)) is not found[3]


def test_agents_of_states_have_batches_of_their_own_and_the_papers_rate(small_release, monkeypatch):
    """What `train` is told of each kind of agent, seen at its batches and its optimizer."""
    release = Release.open(small_release)
    pixels = load_data(release, [Slice("walker-walk/random/none")])
    for name, data, size, rate, optimizer in (
        ("brief", pixels, 64, 2e-3, "Adam"),
        ("brief", pixels.but(frames=None), 256, 1e-3, "Adam"),
        ("quick", pixels, 64, 1e-3, "Muon"),
        ("quick", pixels.but(frames=None), 256, 1e-3, "Adam"),
        ("paper", pixels, 256, 1e-3, "Adam"),
    ):
        torch.manual_seed(0)
        agent = parse_agent("bc" if data.frames else "state-bc")
        learner = make_policy(agent, make_encoder(agent, data.sizes, None, PATCHES), data.sizes, PATCHES)
        seen = []

        def update(batch, learner=learner, seen=seen):
            [group] = learner.optimizers["main"].param_groups
            seen.append((len(batch.action), group["lr"], type(learner.optimizers["main"]).__name__))
            return {"loss": torch.zeros(())}

        monkeypatch.setattr(learner, "update", update)
        train(learner, data, dataclasses.replace(BUDGETS[name], precision="bfloat16"), 1)
        assert seen == [(size, rate, optimizer)] and learner.half == (data.frames is not None)


def test_mazes_are_grouped_as_in_the_paper_and_goal_pairs_are_averaged():
    def result(benchmark, task, mean, pair=None):
        setting = "visible" if pair is None else "fixed"
        part = Slice(f"{task}/expert/{setting}", goal_pair=pair)
        cell = Cell(benchmark, task, setting, parse_agent("bc"), (part,))
        return {"cell": cell.facts(), "score": dict(mean=mean, stderr=3.0, success=0.5)}

    layouts = ("easy7x7a", "easy7x7b", "easy7x7c", "empty7x7", "medium7x7a")
    results = [result("b1", f"ant-maze-{layout}", -100.0 - 30 * i) for i, layout in enumerate(layouts)]
    results += [result("b3", "ant-maze-empty7x7", -200.0 - pair, pair) for pair in range(5)]
    results += [result("b1", "walker-walk", 900.0), result("b1", "ant-maze-tiny", -9.0)]
    own = "ant-maze-mine:****/*..*/****"  # the paper has no table of it
    results += [result("b1", own, -9.0)] + [result("b3", own, -8.0, pair) for pair in (0, 1)]
    facts = {"results": results, "budget": {"scores": True}}
    rows = {(row[0], row[1]): row[5:] for row in _groups(facts)}
    assert rows == {
        ("b1", "ant-maze/single-obstacle"): ("3", "-130 ± 1.7", "50 %"),
        ("b1", "ant-maze/empty"): ("1", "-190 ± 3.0", "50 %"),
        ("b1", "ant-maze/multi-obstacle"): ("1", "-220 ± 3.0", "50 %"),
        ("b3", "ant-maze-empty7x7"): ("5", "-202 ± 1.3", "50 %"),
        ("b3", "ant-maze-mine"): ("2", "-8.0 ± 2.1", "50 %"),
    }
    assert not _groups(facts | {"budget": {"scores": False}})


# -- scores beside the paper's ----------------------------------------------------------------------

QUICK = BUDGETS["quick"]


def beside(task, agent, share, paper, spread=0.0, limit=500):
    """A cell on expert/none whose data returned 100, and which returned that share of it at three starts."""
    cell = Cell("b1", task, "none", parse_agent(agent), (Slice(f"{task}/expert/none"),))
    returns = [100 * (share - spread), 100 * share, 100 * (share + spread)]
    score = {"returns": returns, "mean": float(np.mean(returns)), "stderr": 1.0, "limit": limit}
    paper = paper and {"mean": paper, "stderr": 1}
    return cell, {"score": score, "data": {"mean": 100.0, "limit": 500}, "paper": paper}


SHARES = {"bc": (0.9, 900), "id+bc": (0.7, 800), "ae+bc": (0.5, 500), "lfd+bc": (0.1, 60)}


def test_scores_ranked_as_the_papers_agree_and_reversed_ones_do_not():
    found = comparison(QUICK, [beside("walker-walk", agent, *values) for agent, values in SHARES.items()])
    assert found["ranks"] == [{"task": "walker-walk", "cells": 4, "rho": 1.0, "low": 1.0, "high": 1.0}]
    reverse = zip(SHARES, [0.1, 0.5, 0.7, 0.9], [paper for _, paper in SHARES.values()], strict=True)
    [rank] = comparison(QUICK, [beside("walker-walk", *row) for row in reverse])["ranks"]
    assert rank["rho"] == -1.0


@pytest.mark.slow
def test_ratios_are_shares_of_the_data_and_rho_is_by_task_and_together():
    """By hand: walker's data returned 958, cheetah's 890, humanoid's 766 in the paper, ours 100 throughout."""
    papers = {"walker-walk": 958, "cheetah-run": 890, "humanoid-walk": 766}
    rows = [("bc", 0.9, 0.85), ("id+bc", 0.5, 0.6), ("ae+bc", 0.51, 0.3), ("lfd+bc", 0.1, 0.1)]
    cases = [(task, agent, share, paper * data) for task, data in papers.items() for agent, share, paper in rows]
    found = comparison(QUICK, [beside(*case, spread=0.05) for case in cases])
    assert {round(row["paper_ratio"], 6) for row in found["cells"]} == {0.85, 0.6, 0.3, 0.1}
    numbers = {"ours": 90, "stderr": 1.0, "paper": 0.85 * 958, "ratio": 0.9, "paper_ratio": 0.85}
    where = {"task": "walker-walk", "where": "expert none bc"}
    assert found["cells"][0] == where | {name: pytest.approx(number) for name, number in numbers.items()}
    ranks = {row["task"]: row for row in found["ranks"]}
    assert set(ranks) == {*papers, "all tasks"} and ranks["all tasks"]["cells"] == 12
    walker = ranks["walker-walk"]
    assert walker["rho"] == pytest.approx(0.8)  # one swap of neighbors of four: 1 - 6 * 2 / (4 * 15)
    assert walker["low"] <= 0.8 <= walker["high"] == 1.0


def test_noise_other_limits_and_cells_that_the_paper_lacks_are_not_compared():
    cells = [beside("walker-walk", agent, 0.5, 500) for agent in ("bc", "id+bc", "ae+bc")]
    assert len(comparison(QUICK, cells)["cells"]) == 3
    assert not comparison(BUDGETS["smoke"], cells)["cells"]
    assert not comparison(QUICK, [beside("walker-walk", "bc", 0.5, 500, limit=30)])["cells"]
    assert not comparison(QUICK, [beside("walker-walk", "bc", 0.5, None)])["cells"]
    assert not comparison(QUICK, cells[:1])["ranks"]  # one cell has no rank
