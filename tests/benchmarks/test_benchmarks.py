"""Benchmarks: the right cells for a release, the paper's numbers, online episodes as the task gives them."""

from __future__ import annotations

import dataclasses
import importlib
import shlex
from pathlib import Path

import click
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from PIL import Image

from dmcvb_gen import own_code
from dmcvb_gen.agents.catalog import make_encoder, parse_agent
from dmcvb_gen.agents.data import Normalization, Slice, default_memory, load_data, normalize_pixels
from dmcvb_gen.agents.learners import PARTS
from dmcvb_gen.agents.paper import ObservationProbe, StateProbe
from dmcvb_gen.benchmarks import experiments, report
from dmcvb_gen.benchmarks import validate as validate_module
from dmcvb_gen.benchmarks.evaluate import Evaluator
from dmcvb_gen.benchmarks.experiments import _DataCache, run_cell, train_settings
from dmcvb_gen.benchmarks.paper import paper_score
from dmcvb_gen.benchmarks.profiles import PROFILES, get_profile
from dmcvb_gen.benchmarks.report import compare
from dmcvb_gen.benchmarks.run import planned_steps, run_cells, share_memory
from dmcvb_gen.benchmarks.setup import Setup, fingerprint, keep_precision, open_data, pretraining_of
from dmcvb_gen.benchmarks.suites import BENCHMARKS, Cell, plan_benchmark
from dmcvb_gen.benchmarks.validate import _few_warnings, make_setup
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import CommitRecord, Manifest, SubsetRecord
from dmcvb_gen.dataset.pictures import training_pictures
from dmcvb_gen.dataset.reader import Release, Subset
from dmcvb_gen.distractors import DistractorSampler
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.generate.recipe import expand
from dmcvb_gen.parallel import Needs, Ray, SerialPool
from dmcvb_gen.parallel.ray_pool import share_of_node
from dmcvb_gen.tasks import get_task

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples" / "extending"


def release_of(*names, episodes=100, committed=None, shape=(), **facts):
    """A release of subsets without data, enough to plan with; its shards of ten are committed, or the first few."""
    subsets = {}
    for name in names:
        task, level, setting = name.split("/")
        own = facts if setting == "fixed" else {}
        if task.startswith("ant-maze"):
            views = get_task(task).views
            own = own | dict(family="ant-maze", views=views, hidden_goal=setting != "visible")
        own = own | dict(task=task, level=level, setting=setting, episodes=episodes, episodes_per_shard=10)
        own = dict(size=64, max_steps=get_task(task).max_steps) | dict(shape) | own
        record = SubsetRecord(name=name, **own)
        shards = range((committed or episodes) // 10)
        commits = {
            shard: CommitRecord(subset=name, shard=shard, episodes=(10 * shard, 10 * shard + 10), steps=0, files=())
            for shard in shards
        }
        subsets[name] = Subset("nowhere", record, commits, {})
    records = tuple(subset.record for subset in subsets.values())
    manifest = Manifest(name="x", version="1", license="x", recipe={"seed": 0}, subsets=records)
    return Release("nowhere", manifest, subsets)


WALKER = [f"walker-walk/{level}/{s}" for level in ("expert", "medium", "mixed", "random") for s in ("none", "dynamic")]


def test_b1_has_every_agent_on_every_set_and_states_once():
    cells, missing = plan_benchmark("b1", release_of(*WALKER))
    sets = {(cell.policy_label, cell.setting) for cell in cells}
    levels = {"expert", "medium", "mixed", "random", "expert+medium"}
    assert sets == {(level, setting) for level in levels for setting in ("none", "dynamic")}
    assert len(cells) == 5 * (2 * 6 + 1)
    by_state = [cell for cell in cells if cell.agent.sees_state]
    assert len(by_state) == 5 and {cell.setting for cell in by_state} == {"none"}
    [lacking] = missing
    assert set(lacking.subsets) == {f"walker-walk/{level}/static" for level in ("expert", "medium", "mixed", "random")}
    assert "--distractor static" in lacking.command and "--level medium" in lacking.command
    assert len({cell.id for cell in cells}) == len(cells)


def test_b1_takes_the_agents_asked_for_and_shares_encoders():
    cells, _ = plan_benchmark("b1", release_of(*WALKER), ["id+bc", "id+td3-bc", "bc"])
    assert {cell.agent.name for cell in cells} == {"id+bc", "id+td3-bc", "bc"}
    encoders = {pretraining_of(cell) for cell in cells} - {None}
    assert len(encoders) == 10  # five sets x two distractors, one for both policies


def test_b2_learns_encoders_from_mixed_and_policies_from_twenty_expert_episodes():
    cells, missing = plan_benchmark("b2", release_of(*WALKER))
    assert not missing
    few = [cell for cell in cells if cell.agent.pretrain == "id" and cell.setting == "dynamic"]
    assert [(part.subset, part.episodes) for part in few[0].policy] == [("walker-walk/expert/dynamic", 20)]
    assert [part.subset for part in few[0].pretrain] == ["walker-walk/mixed/dynamic"]
    labels = {(cell.agent.name, cell.policy_label, cell.setting) for cell in cells if not cell.agent.pretrain}
    assert labels == {("bc", "expert", "none")} | {
        ("bc", label, setting) for label in ("20 expert", "20 expert+mixed") for setting in ("none", "dynamic")
    }


def test_b2_names_as_many_episodes_as_there_are():
    cells, _ = plan_benchmark("b2", release_of("walker-walk/expert/none", "walker-walk/mixed/none", episodes=10))
    assert {cell.policy_label for cell in cells} == {"expert", "10 expert", "10 expert+mixed"}


def test_b2_without_mixed_says_how_to_make_it():
    cells, [missing] = plan_benchmark("b2", release_of("walker-walk/expert/none"))
    assert {cell.policy_label for cell in cells} == {"expert", "20 expert"}
    assert missing.subsets == ("walker-walk/mixed/none",)
    assert missing.command.startswith("dmcvb-gen rollout walker-walk --level expert --level mixed --distractor none")


@pytest.mark.parametrize("task, setting", [("walker-walk", "none"), ("ant-maze-empty7x7", "visible")])
def test_what_is_missing_gets_the_shape_of_what_is_there(task, setting):
    names = [f"{task}/expert/{setting}"]
    _, [missing] = plan_benchmark("b1", release_of(*names))
    assert "--size" not in missing.command and "--max-steps" not in missing.command
    _, [missing] = plan_benchmark("b1", release_of(*names, shape=dict(size=32, max_steps=60)))
    assert "--episodes 100 --size 32 --max-steps 60 --out" in missing.command


def test_policies_and_videos_that_the_package_does_not_bring_are_to_be_given():
    _, [missing] = plan_benchmark("b1", release_of("hopper-hop/random/none"))
    assert "--level expert" in missing.command and " --behaviour RUN " in missing.command
    _, [missing] = plan_benchmark("b1", release_of("walker-walk/expert/none"))
    assert "--behaviour" not in missing.command and "--backgrounds" not in missing.command
    videos = {"source": "/videos", "digest": "0" * 64}
    _, [missing] = plan_benchmark("b1", release_of("walker-walk/expert/dynamic", shape=dict(backgrounds=videos)))
    assert " --backgrounds FOLDER " in missing.command


def test_subsets_that_the_user_left_out_are_not_said_to_be_missing():
    chosen = release_of("walker-walk/expert/none")
    _, [missing] = plan_benchmark("b1", chosen, left_out={"walker-walk/expert/static", "walker-walk/medium/none"})
    assert set(missing.left_out) == {"walker-walk/expert/static", "walker-walk/medium/none"}
    assert "walker-walk/expert/dynamic" in missing.subsets and not set(missing.subsets) & set(missing.left_out)
    _, [missing] = plan_benchmark("b2", chosen, left_out={"walker-walk/mixed/none"})
    assert (missing.subsets, missing.command, missing.left_out) == ((), "", ("walker-walk/mixed/none",))


MAZE = "ant-maze-empty7x7"


def b3_of(per_goal=10, committed=None):
    names, facts = (f"{MAZE}/expert/hidden", f"{MAZE}/expert/fixed"), dict(fixed_goals=5, episodes_per_goal=per_goal)
    return plan_benchmark("b3", release_of(*names, episodes=5 * per_goal, committed=committed, **facts))


@pytest.mark.parametrize("per_goal", [10, 20])
def test_b3_has_a_policy_for_each_fixed_goal_and_names_what_is_missing(per_goal):
    cells, missing = b3_of(per_goal)
    assert not missing and {cell.policy[0].goal_pair for cell in cells} == set(range(5))
    assert {(cell.agent.name, bool(cell.pretrain)) for cell in cells} == {
        ("bc", False), ("bc+bc", True), ("id+bc", True)
    }  # fmt: skip
    none, [missing] = plan_benchmark("b3", release_of("walker-walk/expert/none"))
    assert not none and "--fixed-goals 5" in missing.command and "--goal hidden" in missing.command


def test_the_one_command_that_b3_names_makes_one_release_that_has_its_data(tmp_path, monkeypatch):
    _, [missing] = plan_benchmark("b3", release_of("walker-walk/expert/none"))
    program, command, *words = shlex.split(missing.command)
    assert (program, command) == ("dmcvb-gen", "rollout")
    planned = []

    def stop(recipe, *_):
        planned.extend(expand(recipe))
        raise click.Abort()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dmcvb_gen.generate.rollout.make_plan", stop)
    result = CliRunner().invoke(main, [command, *words])
    assert result.exit_code == 1 and {request.name for request in planned} == set(missing.subsets), result.output
    cells, none = plan_benchmark("b3", release_of(*missing.subsets, fixed_goals=5, episodes_per_goal=10))
    assert cells and not none


def test_b3_of_a_part_of_a_release_has_the_goals_that_are_whole_and_says_which_are_not():
    cells, [missing] = b3_of(per_goal=20, committed=50)
    assert {cell.policy[0].goal_pair for cell in cells} == {0, 1}
    assert missing.subsets == (f"{MAZE}/expert/fixed, episodes of goal pairs 2, 3, 4",)


def test_mazes_have_the_papers_two_levels_in_b1_and_others_where_they_are_there():
    cells, [missing] = plan_benchmark("b1", release_of(f"{MAZE}/expert/visible", f"{MAZE}/random/visible"), ["bc"])
    assert {cell.policy_label for cell in cells} == {"expert", "random"}
    assert missing.subsets == (f"{MAZE}/medium/visible",)


def test_ablations_vary_frames_k_and_the_share_of_the_data():
    cells, _ = plan_benchmark("ablations", release_of("walker-walk/expert/none"))
    names = {cell.agent.name for cell in cells}
    assert {"bc:frames=1", "bc", "bc+bc", "id+bc:k=5", "id+bc:k=10,sample"} <= names
    assert {part.share for cell in cells for part in cell.policy} == {0.01, 0.05, 0.1, 0.25, 0.5, 1.0}


@pytest.mark.parametrize("name", ["walker-walk/expert/none", f"{MAZE}/expert/visible"])
@pytest.mark.parametrize("episodes, shares", [(10, {0.1, 0.25, 0.5, 1}), (20, {0.05, 0.1, 0.25, 0.5, 1})])
def test_shares_that_come_to_the_same_episodes_are_trained_once(name, episodes, shares):
    cells, _ = plan_benchmark("ablations", release_of(name, episodes=episodes), ["bc"])
    assert [cell.policy[0].share for cell in cells] == sorted(shares, key=lambda share: (share < 1, share))


def test_unknown_benchmarks_and_profiles_list_the_known_ones():
    with pytest.raises(UnknownNameError, match=", ".join(sorted(BENCHMARKS.all()))):
        plan_benchmark("b4", release_of(*WALKER))
    with pytest.raises(UnknownNameError, match="brief, paper, quick, smoke"):
        get_profile("slow")


def test_the_papers_scores_are_those_of_its_table():
    assert paper_score("walker-walk", "expert", "dynamic", "null+bc") == (913, 10)
    assert paper_score("humanoid-walk", "expert+medium", "static", "bc(state)") == (585, 21)
    assert paper_score("walker-walk", "expert", "dynamic_hard", "null+bc") is None
    assert paper_score("walker-walk", "expert", "none", None) is None


def test_the_paper_profile_is_the_papers_and_a_scaled_one_says_so():
    paper = PROFILES["paper"]
    assert (paper.pixel_steps, paper.batch_size, paper.episodes) == (400_000, 256, 30)
    assert paper.pixel_steps // paper.evaluations == 20_000
    half = PROFILES["quick"].scaled(0.5)
    assert half.pixel_steps == PROFILES["quick"].pixel_steps / 2 and "x0.5" in half.name and "0.5 times" in half.note
    assert not PROFILES["smoke"].scores


# -- online evaluation ----------------------------------------------------------------------------


class Recorder:
    """A policy that moves a little, the same way every time, and remembers what it saw."""

    def __init__(self, size):
        self.size, self.seen = size, []

    def precision(self):
        return torch.autocast("cpu", enabled=False)

    def act(self, observation):
        self.seen.append(observation.clone())
        return torch.full((len(observation), self.size), 0.1)


def rewards_by_hand(evaluator, actions, steps):
    batch = evaluator.task.batch(evaluator.episodes)
    state = batch.reset(evaluator.streams("initial_state"))
    total, states = 0, [state]
    for _ in range(steps):
        result = batch.step(np.full((evaluator.episodes, actions), 0.1))
        total = total + result.reward
        states.append(result.state)
    return total, states


def test_scores_are_the_tasks_rewards_and_states_are_normalized(small_release):
    subset = open_release(small_release)["walker-walk/random/none"]
    normalization = Normalization(torch.full((24,), 0.5), torch.full((24,), 2.0))
    evaluator = Evaluator(subset, pixels=False, normalization=normalization, episodes=3, max_steps=6)
    policy = Recorder(6)
    score = evaluator(policy)
    returns, states = rewards_by_hand(evaluator, 6, 6)
    np.testing.assert_allclose(score.returns, returns, rtol=1e-6)
    assert score.mean == pytest.approx(returns.mean())
    assert score.stderr == pytest.approx(returns.std(ddof=1) / np.sqrt(3))
    np.testing.assert_allclose(policy.seen[4], (states[4] - 0.5) / 2, rtol=1e-5, atol=1e-5)
    assert score.success is None and score.pictures is None


def test_pictures_are_of_unseen_videos_newest_frame_last(small_release):
    subset = open_release(small_release)["walker-walk/random/dynamic"]
    evaluator = Evaluator(subset, episodes=2, max_steps=4, shots=2)
    policy = Recorder(6)
    score = evaluator(policy)
    evaluator.close()
    assert evaluator._videos.split == "val"
    stacks = [seen.unflatten(1, (3, 3)) for seen in policy.seen]
    assert stacks[0].shape == (2, 3, 3, 16, 16) and stacks[0].abs().max() <= 0.5
    assert torch.equal(stacks[0][:, 0], stacks[0][:, 2])  # the first frame is repeated
    assert torch.equal(stacks[3][:, 0], stacks[2][:, 1]) and torch.equal(stacks[3][:, 1], stacks[2][:, 2])
    assert not torch.equal(stacks[3][:, 2], stacks[2][:, 2])
    assert score.pictures.shape == (2, 16, 16, 3) and score.pictures.std() > 5


def test_an_agent_is_shown_in_evaluation_what_it_is_shown_in_training(small_release):
    subset = open_release(small_release)["walker-walk/random/none"]
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
    subset = open_release(small_release)["walker-walk/random/none"]
    evaluator = Evaluator(subset, pixels=False, episodes=8)
    first = evaluator.task.batch(8).reset(evaluator.streams("initial_state"))
    stored = subset.read("state")[:, 0]
    assert np.abs(first[:, None] - stored[None]).max(axis=2).min() > 1e-3


def test_mazes_are_scored_by_success_and_start_where_the_pair_says():
    subset = release_of(f"{MAZE}/expert/fixed")[f"{MAZE}/expert/fixed"]
    task = get_task("ant-maze-empty7x7")
    normalization = Normalization(torch.zeros(task.state_size), torch.ones(task.state_size))
    evaluator = Evaluator(
        subset, pixels=False, normalization=normalization, episodes=2, max_steps=3, pair=((1, 1), (5, 5))
    )
    policy = Recorder(8)
    score = evaluator(policy)
    assert score.success == 0.0 and score.speed is None and score.mean < 0
    place = policy.seen[0][:, task.state_slices["walker_position"]]
    start = torch.as_tensor(task.layout.world((1, 1)), dtype=place.dtype)
    assert (place[:, :2] - start).abs().max() <= 0.25 + 1e-5 and not torch.equal(place[0], place[1])


def test_agents_see_three_of_a_mazes_views_with_the_goal_hidden_where_the_setting_hides_it(monkeypatch):
    task = get_task("ant-maze-empty7x7")
    everything = tuple(f"{root}/{view}" for root in ("pixels", "pixels_hidden_goal") for view in task.views)
    monkeypatch.setattr(Subset, "pixel_arrays", property(lambda self: everything))
    for setting, root in (("visible", "pixels"), ("hidden", "pixels_hidden_goal"), ("fixed", "pixels_hidden_goal")):
        subset = release_of(f"ant-maze-empty7x7/expert/{setting}").subsets[f"ant-maze-empty7x7/expert/{setting}"]
        assert training_pictures(subset).arrays == tuple(f"{root}/{view}" for view in ("top", "egocentric", "follow"))


def without_time(point):
    return {name: value for name, value in point.items() if name != "seconds"}


# -- running cells --------------------------------------------------------------------------------


def test_cells_in_processes_give_what_cells_in_this_one_give(small_release, tmp_path):
    release = open_release(small_release)
    cells = [cell for cell in plan_benchmark("b1", release, ["state-bc"])[0]][:1]
    scores = []
    for workers in (1, 2):
        setup = Setup(str(small_release), str(tmp_path / str(workers)), PROFILES["smoke"])
        [(cell, result)] = list(run_cells(setup, cells, workers))
        scores.append((cell.id, result["score"]["returns"], result["curve"][-1]["loss"]))
    assert scores[0][1] == pytest.approx(scores[1][1]) and scores[0][2] == pytest.approx(scores[1][2])


def test_the_cells_of_a_run_open_the_release_once(small_release, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("dmcvb_gen.benchmarks.setup.open_data", lambda setup: opened.append(1) or open_data(setup))
    cells = plan_benchmark("b1", open_release(small_release), ["bc"])[0][:2]
    for run in (1, 2):
        setup = Setup(str(small_release), str(tmp_path / str(run)), PROFILES["smoke"])
        results = dict(run_cells(setup, cells))
        assert len(cells) == len(results) == 2 and not any("error" in result for result in results.values())
        assert len(opened) == run


def test_a_cell_that_cannot_run_does_not_stop_the_others(small_release, tmp_path):
    release = open_release(small_release)
    cells = [c for c in plan_benchmark("b1", release, ["dino+bc", "state-bc"])[0] if c.setting == "none"]
    setup = Setup(str(small_release), str(tmp_path), PROFILES["smoke"])
    results = {cell.agent.name: result for cell, result in run_cells(setup, cells)}
    assert "--dino-weights" in results["dino+bc"]["error"] and results["state-bc"]["score"]["mean"] >= 0


def test_processes_train_each_encoder_before_its_cells(small_release, tmp_path):
    cells = [c for c in plan_benchmark("b1", open_release(small_release), ["state-bc", "id+bc"])[0]]
    cells = [c for c in cells if c.setting in ("none", "static") and c.policy_label == cells[0].policy_label]
    steps = []
    setup = Setup(str(small_release), str(tmp_path), PROFILES["smoke"])
    results = dict(run_cells(setup, cells, 2, lambda what, made: steps.append(made)))
    assert results.keys() == set(cells) and not any("error" in result for result in results.values())
    encoders = {pretraining_of(cell) for cell in cells if cell.agent.pretrain}
    assert len(encoders) == 2
    for cell in cells:
        if cell.agent.pretrain:
            trained = (tmp_path / "encoders" / f"{pretraining_of(cell).id}.json").stat().st_mtime_ns
            assert trained < (tmp_path / "cells" / f"{cell.id}.json").stat().st_mtime_ns
    assert sum(steps) == planned_steps(setup.profile, cells)


def test_a_result_of_another_seed_or_profile_is_not_taken_for_this_one(small_release, tmp_path):
    cells = plan_benchmark("b1", open_release(small_release), ["state-bc"])[0][:1]
    made = []
    for seed, profile in ((0, "smoke"), (0, "smoke"), (1, "smoke")):
        steps = []
        setup = Setup(str(small_release), str(tmp_path), PROFILES[profile], seed=seed)
        list(run_cells(setup, cells, tick=lambda what, count, steps=steps: steps.append(count)))
        made.append(sum(steps))
    assert made == [3, 0, 3]
    with pytest.raises(DmcvbError, match="committed|release"):
        open_release(tmp_path)


def test_what_a_score_hangs_on_besides_the_data_is_in_its_fingerprint(small_release, tmp_path):
    from safetensors.torch import save_file

    release, weights = open_release(small_release), tmp_path / "dino.safetensors"
    cells = plan_benchmark("b1", release, ["dino+bc", "bc", "state-bc"])[0]
    by_agent = {cell.agent.name: cell for cell in cells if cell.setting == "dynamic"}
    own = tmp_path / "clips" / "val" / "one"
    own.mkdir(parents=True)
    Image.fromarray(np.full((8, 8, 3), 200, np.uint8)).save(own / "0.png")
    save_file({"x": torch.zeros(1)}, str(weights))
    plain = Setup(str(small_release), str(tmp_path), PROFILES["smoke"], dino_weights=str(weights))
    moved = dataclasses.replace(plain, backgrounds=str(tmp_path / "clips"))
    assert fingerprint(plain, release, by_agent["bc"]) != fingerprint(moved, release, by_agent["bc"])
    [by_state] = [cell for cell in cells if cell.agent.sees_state]
    assert fingerprint(plain, release, by_state) == fingerprint(moved, release, by_state)  # states show no videos
    before = fingerprint(plain, release, by_agent["dino+bc"]), fingerprint(plain, release, by_agent["bc"])
    save_file({"x": torch.ones(1)}, str(weights))
    after = fingerprint(plain, release, by_agent["dino+bc"]), fingerprint(plain, release, by_agent["bc"])
    assert before[0] != after[0] and before[1] == after[1]


def test_the_precision_of_pictures_is_in_the_fingerprint_of_what_sees_them(small_release, tmp_path):
    release = open_release(small_release)
    cells = {cell.agent.name: cell for cell in plan_benchmark("b1", release, ["bc", "id+bc", "state-bc"])[0]}
    exact = Setup(str(small_release), str(tmp_path), PROFILES["smoke"])
    rounded = dataclasses.replace(exact, precision="bfloat16")

    def differ(work):
        return fingerprint(exact, release, work) != fingerprint(rounded, release, work)

    assert differ(cells["bc"]) and differ(pretraining_of(cells["id+bc"])) and not differ(cells["state-bc"])


def test_a_report_that_goes_on_keeps_the_precision_that_auto_took(monkeypatch, tmp_path):
    taken = iter(("bfloat16", "float32"))
    monkeypatch.setattr(
        validate_module, "choose_precision", lambda asked, *_: next(taken) if asked == "auto" else asked
    )
    first = make_setup("release", out=tmp_path)
    keep_precision(first)
    again, asked = make_setup("release", out=tmp_path), make_setup("release", out=tmp_path, precision="float32")
    assert (first.precision, again.precision, asked.precision) == ("bfloat16", "bfloat16", "float32")
    assert make_setup("release", out=tmp_path / "other").precision == "float32"


def test_an_agent_of_another_package_that_changed_is_another_one(small_release, tmp_path, monkeypatch):
    release, file = open_release(small_release), tmp_path / "theirs.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(PARTS, "_things", dict(PARTS.all()))
    monkeypatch.setattr(PARTS, "_code", dict(PARTS._code))
    file.write_text((EXAMPLES / "agent.py").read_text().replace("linear-bc", "their-bc"))
    importlib.import_module("theirs")
    cells = {cell.agent.name: cell for cell in plan_benchmark("b1", release, ["their-bc", "bc"])[0]}
    setup = Setup(str(small_release), str(tmp_path), PROFILES["smoke"])
    before = {name: fingerprint(setup, release, cell) for name, cell in cells.items()}
    file.write_text(file.read_text() + "\n# changed\n")
    with pytest.raises(DmcvbError, match="old code still runs; restart Python"):
        fingerprint(setup, release, cells["their-bc"])
    own_code._digests.clear()  # as in a new process
    after = {name: fingerprint(setup, release, cell) for name, cell in cells.items()}
    assert before["their-bc"] != after["their-bc"] and before["bc"] == after["bc"]


def test_workers_share_the_memory_for_pictures(small_release):
    setup = Setup(str(small_release), "out", PROFILES["smoke"], memory=1000)
    assert share_memory(setup, 4).memory == 250
    with_default = share_memory(dataclasses.replace(setup, memory=None), 4).memory
    assert with_default == pytest.approx(default_memory() / 4, rel=0.2)


def test_cells_on_a_cluster_take_no_more_than_their_share_of_a_node(small_release, tmp_path, monkeypatch):
    nodes = [
        {"Alive": True, "Resources": {"CPU": 8.0, "memory": 8e9, "GPU": 2.0}},
        {"Alive": True, "Resources": {"CPU": 5.0, "memory": 1e10}},
        {"Alive": True, "Resources": {"CPU": 1.0, "memory": 1e6}},  # too few cores for two
        {"Alive": False, "Resources": {}},
    ]
    assert share_of_node(nodes, Needs(cpus=2)) == 2e9
    assert share_of_node(nodes, Needs(cpus=2, gpus=1)) == 4e9
    assert share_of_node(nodes, Needs(cpus=16)) is None

    class Cluster(SerialPool):
        def memory_each(self):
            return 4_000_000

    held = []
    monkeypatch.setattr("dmcvb_gen.benchmarks.run.open_pool", lambda *_, **__: Cluster())
    monkeypatch.setattr("dmcvb_gen.benchmarks.run.run_cell", lambda setup, *_: held.append(setup.memory) or {})
    cells = plan_benchmark("b1", open_release(small_release), ["state-bc"])[0][:1]
    setup = Setup(str(small_release), str(tmp_path), PROFILES["smoke"])
    for given in (setup, dataclasses.replace(setup, memory=1000), dataclasses.replace(setup, device="cuda")):
        list(run_cells(given, cells, Ray("nowhere:1")))
    assert held == [2_000_000, 1000, None]  # a cell has a GPU, and its memory, alone


@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
@pytest.mark.parametrize("decoder", ["observation decoder", "state decoder"])
def test_a_cell_that_was_stopped_in_a_decoder_goes_on_there(whole, decoder, request, tmp_path, monkeypatch):
    folder = request.getfixturevalue(whole)
    cell = plan_benchmark("b1", open_release(folder), ["bc"])[0][0]
    one, other = (Setup(str(folder), str(tmp_path / name), PROFILES["smoke"]) for name in ("one", "other"))
    expected = run_cell(one, cell)
    monkeypatch.setattr("dmcvb_gen.agents.trainer.SAVE_SECONDS", 0.0)
    made, again = [], []

    def stop(what, steps):
        made.append(what)
        if made.count(decoder) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cell(other, cell, stop)
    found = run_cell(other, cell, lambda what, steps: again.append((what, steps)))
    at_once = [steps for what, steps in again if what == decoder][0]
    assert at_once == 1 and sum(steps for _, steps in again) == planned_steps(other.profile, [cell])

    def plain(result):
        curves = {name: [without_time(point) for point in curve] for name, curve in result["curves"].items()}
        return result | {"curves": curves}

    assert plain(found["inspection"]) == plain(expected["inspection"])
    decoding = sum(curve[-1]["seconds"] for curve in found["inspection"]["curves"].values())
    assert found["seconds"]["all"] >= found["seconds"]["inspection"] >= decoding > 0
    assert list(found["score"]["returns"]) == list(expected["score"]["returns"])
    assert not list((tmp_path / "other").rglob("*.run"))


@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
def test_an_inspection_says_what_it_does_and_needs_no_kept_latents(whole, request, tmp_path, monkeypatch):
    folder, found, told = request.getfixturevalue(whole), {}, {}
    cell = plan_benchmark("b1", open_release(folder), ["bc"])[0][0]
    profile, original = dataclasses.replace(PROFILES["smoke"], frozen_shift=False), experiments.encoded

    def inspection(draws):
        monkeypatch.setattr(experiments, "encoded", lambda *a: original(*a[:3], draws, a[-1]))
        ticks = []
        setup = Setup(str(folder), str(tmp_path / str(draws)), profile)
        found[draws] = run_cell(setup, cell, lambda *tick: ticks.append(tick))["inspection"]
        assert sum(steps for _, steps in ticks) == planned_steps(profile, [cell])
        told[draws] = {what for what, _ in ticks}

    inspection(0)
    inspection(10**9)
    assert "encoding, 100%" in told[10**9] - told[0]
    assert "test errors of the decoders" in told[0]
    for name in ("state_l1", "observation_mse", "state_mse"):
        assert found[0][name] == pytest.approx(found[10**9][name], rel=1e-3)


@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
def test_test_errors_of_decoders_that_say_nothing_are_the_spread_of_the_data(whole, request, tmp_path):
    folder = str(request.getfixturevalue(whole))
    subset = next(iter(open_release(folder).subsets.values()))
    setup = Setup(folder, str(tmp_path), PROFILES["smoke"])
    data, network = load_data({subset.name: subset}, [Slice(subset.name)], pixels=True), setup.profile.network
    encoder = make_encoder(parse_agent("bc"), data.sizes, None, network)
    readouts = {
        "observation": ObservationProbe(encoder, data.sizes, network),
        "state": StateProbe(encoder, data.sizes),
    }
    for probe in readouts.values():
        for weights in probe.parameters():
            weights.data.zero_()
    errors = experiments._test_errors(readouts, data, setup, subset.task, lambda *_: None)
    rows = data.hold_out_rows
    whole_batch = data.transitions(rows)
    assert len(rows) and errors["observation_mse"] == pytest.approx(float(whole_batch.observation.square().mean()))
    assert errors["state_mse"] == pytest.approx(float(whole_batch.state.square().mean()), rel=1e-5)
    own = whole_batch.state.abs().mean(dim=0) * data.normalization.std / experiments.state_units(setup, subset.task)
    assert errors["state_l1"] == pytest.approx(
        {name: float(own[part].mean()) for name, part in get_task(subset.task).state_slices.items()}, rel=1e-5
    )


@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
def test_a_picture_cell_is_made_again_if_the_units_of_its_state_errors_change(whole, request, tmp_path):
    folder = request.getfixturevalue(whole)
    release, setup = open_release(folder), Setup(str(folder), str(tmp_path), PROFILES["smoke"])
    cells = {agent: plan_benchmark("b1", release, [agent])[0][0] for agent in ("bc", "state-bc")}
    before = {agent: fingerprint(setup, release, cell) for agent, cell in cells.items()}
    other = next(iter(release.subsets.values()))
    record = other.record.model_copy(update={"name": f"{other.task}/other/{other.setting}"})
    one = dict(list(other.commits.items())[:1])
    manifest = release.manifest.model_copy(update={"subsets": (*release.manifest.subsets, record)})
    grown = Release(release.root, manifest, release.subsets | {record.name: Subset(folder, record, one, {})})
    assert fingerprint(setup, grown, cells["bc"]) != before["bc"]
    assert fingerprint(setup, grown, cells["state-bc"]) == before["state-bc"]


def test_any_error_of_a_cell_is_its_own_with_its_traceback_in_a_log(small_release, tmp_path, monkeypatch):
    cells = [c for c in plan_benchmark("b1", open_release(small_release), ["state-bc"])[0]][:1]
    setup = Setup(str(small_release), str(tmp_path), PROFILES["smoke"], seed=7)  # data that no other test has loaded

    def out_of_memory(*_, **__):
        raise MemoryError("no room for 7 GB")

    monkeypatch.setattr("dmcvb_gen.benchmarks.experiments.load_data", out_of_memory)
    [(cell, result)] = list(run_cells(setup, cells))
    log = tmp_path / "cells" / f"{cell.id}.log"
    assert result["error"] == f"MemoryError: no room for 7 GB (all of it in {log})"
    assert "out_of_memory" in log.read_text()
    monkeypatch.undo()
    [(_, result)] = list(run_cells(setup, cells))
    assert "error" not in result and not log.exists()


def compared(task, pairs, benchmark="b1", setting="x"):
    """What `compare` says of agents' mean scores."""
    part = (Slice(f"{task}/expert/{setting}"),)
    results = [
        (Cell(benchmark, task, setting, parse_agent(name), part), {"score": {"mean": mean}}) for name, mean in pairs
    ]
    return {cell.agent.name: compare(cell, results) for cell, _ in results}


def test_a_negative_return_is_set_beside_its_reference_by_the_difference():
    maze = compared(MAZE, [("state-bc", -40.0), ("bc", -800.0)])["bc"]
    assert maze["share"] is None and maze["difference"] == -760.0 and maze["reference"] == "BC(state)"
    walker = compared("walker-walk", [("state-bc", 800.0), ("bc", 400.0)])["bc"]
    assert walker["share"] == 0.5
    fixed = compared(MAZE, [("bc", -60.0), ("id+bc", -45.0)], "b3")["id+bc"]
    assert fixed["difference"] == 15.0 and fixed["reference"] == "BC on these episodes"


def test_ablations_are_set_beside_bc_on_all_of_the_expert_without_distractors():
    frames = compared("walker-walk", [("bc", 800.0), ("bc:frames=1", 400.0)], "ablations", "none")["bc:frames=1"]
    assert (frames["share"], frames["reference"]) == (0.5, "BC on all of expert/none")
    maze = compared(MAZE, [("bc", -60.0), ("id+bc:k=5", -45.0)], "ablations", "visible")["id+bc:k=5"]
    assert (maze["difference"], maze["reference"]) == (15.0, "BC on all of expert/visible")


def test_a_cells_seconds_are_those_of_all_its_sessions(small_release, tmp_path, monkeypatch):
    points = [{"step": 10, "score": {"mean": 1.0, "seconds": 20.0}, "seconds": 100.0}]
    monkeypatch.setattr(
        "dmcvb_gen.benchmarks.experiments.train", lambda *args, **options: points
    )  # the rest was made before
    cells = plan_benchmark("b1", open_release(small_release), ["state-bc"])[0][:1]
    [(_, result)] = list(run_cells(Setup(str(small_release), str(tmp_path), PROFILES["smoke"]), cells))
    seconds = result["seconds"]
    assert (seconds["training"], seconds["evaluation"]) == (80, 20) and seconds["all"] >= 100
    assert result["steps_per_second"] == PROFILES["smoke"].state_steps / 80


def test_data_that_grew_or_look_otherwise_are_read_again(small_release):
    release, part = open_release(small_release), (Slice("walker-walk/random/none"),)
    setup, cache = Setup(str(small_release), "out", PROFILES["smoke"]), _DataCache()
    subset = release[part[0].subset]
    half = Subset(subset.root, subset.record, {0: subset.commits[0]}, {})
    less = Release(release.root, release.manifest, {subset.name: half})
    assert [len(cache.get(setup, one, part, False, 3).lengths) for one in (less, less, release)] == [2, 2, 3]
    before = cache._data
    assert cache.get(setup, release, part, False, 3) and cache._data is before
    cache.get(dataclasses.replace(setup, backgrounds="elsewhere"), release, part, False, 3)
    assert cache._data is not before


def test_agents_of_states_have_batches_of_their_own_and_the_papers_rate():
    setup = Setup(root="r", out="o", profile=PROFILES["brief"])
    pixels, states = train_settings(setup, 10, 64), train_settings(setup, 10, 64, pixels=False)
    assert (pixels.batch_size, pixels.rate, pixels.shift, pixels.half) == (64, 2.0, True, False)
    assert not train_settings(setup, 10, 65).shift  # fewer than ten passes over the data
    assert (states.batch_size, states.rate, states.half) == (256, 1.0, False)
    quick = dataclasses.replace(setup, profile=PROFILES["quick"])
    assert train_settings(quick, 10, 64).muon and not train_settings(quick, 10, 64, pixels=False).muon
    whole = train_settings(Setup(root="r", out="o", profile=PROFILES["paper"]), 10, 10**9)
    assert (whole.batch_size, whole.rate, whole.shift, whole.decay) == (256, 1.0, True, False)


def test_a_release_so_small_that_quick_shifts_its_pictures_is_told(small_release):
    cells = plan_benchmark("b1", open_release(small_release), ["bc", "state-bc", "id+bc"])[0]
    [bc] = {cell for cell in cells if cell.agent.name == "bc" and cell.setting == "none"}
    quick = PROFILES["quick"]

    def told(transitions: int, cell=bc, profile=quick) -> list[str]:
        return [
            issue.message for issue in _few_warnings(profile, [(cell, {"transitions": transitions, "episodes": 100})])
        ]

    assert told(quick.pixel_steps * quick.batch_size // 10)
    assert not told(quick.pixel_steps * quick.batch_size // 10 + 1)
    [text] = told(47_500)  # 5 of the 100 are held out
    assert "passes 22 times over 100 episodes" in text and "with 216 episodes" in text
    assert not told(47_500, profile=PROFILES["paper"]) and not told(47_500, profile=PROFILES["smoke"])
    assert not any(told(47_500, cell) for cell in cells if cell.agent.name != "bc")


def test_mazes_are_grouped_as_in_the_paper_and_goal_pairs_are_averaged():
    def result(benchmark, task, label, mean, scores=True):
        cell = dict(benchmark=benchmark, task=task, policy_label=label, setting="visible", agent_name="bc")
        score = dict(mean=mean, stderr=3.0, success=0.5)
        return dict(cell=cell | dict(pretrain_label=""), profile=dict(scores=scores), score=score)

    layouts = ("easy7x7a", "easy7x7b", "easy7x7c", "empty7x7", "medium7x7a")
    results = [result("b1", f"ant-maze-{layout}", "expert", -100.0 - 30 * i) for i, layout in enumerate(layouts)]
    results += [result("b3", "ant-maze-empty7x7", f"expert goal {pair}", -200.0 - pair) for pair in range(5)]
    results += [result("b1", "walker-walk", "expert", 900.0), result("b1", "ant-maze-tiny", "expert", -9.0)]
    own = "ant-maze-empty7x7@geodesic"  # the paper has no table of it
    results += [result("b1", own, "expert", -9.0)] + [result("b3", own, f"expert goal {pair}", -8.0) for pair in (0, 1)]
    rows = {(row[0], row[1]): row[5:] for row in report._groups(results)}
    assert rows == {
        ("b1", "ant-maze/single-obstacle"): ("3", "-130 ± 1.7", "50 %"),
        ("b1", "ant-maze/empty"): ("1", "-190 ± 3.0", "50 %"),
        ("b1", "ant-maze/multi-obstacle"): ("1", "-220 ± 3.0", "50 %"),
        ("b3", "ant-maze-empty7x7"): ("5", "-202 ± 1.3", "50 %"),
        ("b3", "ant-maze-empty7x7-geodesic"): ("2", "-8.0 ± 2.1", "50 %"),
    }
    assert not report._groups([result("b1", "ant-maze-empty7x7", "expert", -9.0, scores=False)])


def test_only_networks_that_see_pictures_compute_in_bfloat16():
    setup = Setup(root="r", out="o", profile=PROFILES["brief"], precision="bfloat16")
    assert train_settings(setup, 10, 64).half and not train_settings(setup, 10, 64, pixels=False).half
