"""validate: a sound release gives a page and exit code 0; each kind of damage fails by the check meant for it."""

import errno
import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import dmcvb_gen
from dmcvb_gen.agents import catalog
from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.agents.data import Slice, load_data
from dmcvb_gen.agents.networks import PATCHES
from dmcvb_gen.benchmarks import checks
from dmcvb_gen.benchmarks.cell import data_score
from dmcvb_gen.benchmarks.evaluate import load_agent
from dmcvb_gen.benchmarks.plan import BUDGETS, Cell, goal_cells, only, plan_benchmark
from dmcvb_gen.benchmarks.report import CHECKS, STATISTICS, _tables, curve_figures, render_page
from dmcvb_gen.benchmarks.validate import validate
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import PolicyRecord, record_path
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.references import reference_returns
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from tests.conftest import TINY_MAZE, invoke, maze_recipe, rewrite, roll_out, short_recipe, small_recipe
from tests.distractors.test_backgrounds import write_frames
from tests.release.test_verify import put

NAME = "walker-walk/expert/dynamic"


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Two expert episodes with distractors, a shard each."""
    folder = tmp_path_factory.mktemp("validate") / "tiny"
    roll_out(small_recipe(name="tiny", levels="expert", settings="dynamic", episodes=2, episodes_per_shard=1), folder)
    return folder


@pytest.fixture
def copy(release, tmp_path):
    return shutil.copytree(release, tmp_path / "copy")


@pytest.mark.slow_cases("small_mazes", "small_release")
@pytest.mark.parametrize("whole", ["small_release", "small_mazes"])
def test_subsets_are_checked_side_by_side_and_only_those_asked_for(whole, tmp_path, request):
    folder = shutil.copytree(request.getfixturevalue(whole), tmp_path / "damaged")
    damaged, other, *rest = Release.open(folder).subsets

    def black(group):
        for name in group:
            if name.startswith("pixels"):
                group[name][:] = 0

    rewrite(folder, damaged, black)
    release, looked_at = only(Release.open(folder), [damaged, other]), []
    alone, beside = checks.check_structure(release, tick=looked_at.append), checks.check_structure(release, workers=2)
    told, layers = Counter(looked_at), Release.open(folder).layers
    assert rest and not any(told[name] for name in rest) and alone.checked["subsets"] == 2
    assert told[damaged] and told[other] and all(told[name] for name in layers)  # bytes are checked everywhere
    assert {finding.subset for finding in alone.findings} == {damaged}
    assert (beside.findings, beside.warnings, beside.checked) == (alone.findings, alone.warnings, alone.checked)


# -- the command ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(release, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    options = ("--profile=smoke", "--agents=bc,state-bc,id+bc", "--workers=1", "--threads=1")
    return out, invoke("validate", release, *options, "--out", out, code=0)


def test_a_sound_release_passes_and_every_score_carries_its_profile(report):
    out, result = report
    scores = [line for line in result.output.splitlines() if line.startswith(f"{NAME} ")]
    assert len(scores) == 3 and all(" [smoke]" in line for line in scores)
    assert "paper 9" not in result.output, "noise is not set beside the paper's numbers"
    assert "b1: not in the release: walker-walk/expert/none" in result.output
    page, facts = (out / "report.html").read_text(), json.loads((out / "report.json").read_text())
    assert page.index("All checks passed") < page.index("Structure") < page.index("Episode returns")
    assert "Incomplete" not in page
    assert "paper 913" not in page and "claims no score" in page
    assert page.count(" [smoke]</b>") == 3
    assert page.count("data:image/png;base64") >= 5 and "src='http" not in page and "href=" not in page
    by_agent = {entry["cell"]["agent"]: entry for entry in facts["results"]}
    assert facts["sound"] and set(by_agent) == {"bc", "state-bc", "id+bc"}
    assert by_agent["state-bc"]["paper"] == {"mean": 960, "stderr": 2} and by_agent["state-bc"]["share"] == 1
    assert by_agent["bc"]["paper"] is None  # of images of 64 pixels
    assert by_agent["id+bc"]["pretraining"]["curve"] and by_agent["id+bc"]["inspection"]["state_mse"] > 0
    assert (out / "cells" / "b1_walker-walk_dynamic_bc_expert.decoder.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("task, setting", [("walker-walk", "dynamic"), ("ant-maze-empty7x7", "visible")])
def test_label_budgets_are_validated_on_a_release_of_experts(task, setting, tmp_path, monkeypatch):
    shape = dict(levels=["expert", "random"], settings=setting, episodes=5, max_steps=30)
    roll_out(short_recipe(tasks=task, **shape), tmp_path / "experts")
    monkeypatch.setitem(BUDGETS, "smoke", replace(BUDGETS["smoke"], scores=True, readout_steps=0, episode_steps=30))
    result = validate(tmp_path / "experts", out=tmp_path / "out", benchmarks="b4", workers=1)
    facts = json.loads((tmp_path / "out" / "report.json").read_text())
    assert result.sound, result.failed
    found = {(one["cell"]["agent"], one["labels"]["policy"]): one for one in facts["results"]}
    latent = ("lapo+bc", "laom+bc", "laom-labels+bc")
    assert set(found) == {("bc", "expert"), *((agent, "2 expert") for agent in ("bc", *latent))}
    assert found["lapo+bc", "2 expert"]["episodes"] == 2
    assert all(found[agent, "2 expert"]["pretraining"]["action_probe"] > 0 for agent in latent)
    subsets = Release.open(tmp_path / "experts").subsets
    low, high = (subsets[f"{task}/{level}/{setting}"].returns.mean() for level in ("random", "expert"))
    for one in found.values():
        assert one["score"]["normalized"] == pytest.approx(100 * (one["score"]["mean"] - low) / (high - low))
    page = (tmp_path / "out" / "report.html").read_text()
    assert " BC on all labels" in page and page.count("<br>normalized ") == 5
    assert len(re.findall(r"probe misses \d+ % of the actions", page)) == 3


def test_its_tables_have_the_numbers_of_its_facts(report):
    facts = json.loads((report[0] / "report.json").read_text())
    tables = _tables(facts)
    assert [row[0] for row in tables["checks"]] == list(CHECKS) and not any(found for *_, found in tables["checks"])
    [(name, values)] = facts["returns"].items()
    assert tables["returns"]["rows"][0] == [name, *(f"{values[statistic]:.1f}" for statistic in STATISTICS)]
    [scores] = tables["scores"]
    shown = dict(zip(scores["head"][4:], scores["rows"][0]["scores"], strict=True))
    for entry in facts["results"]:
        lines = shown.pop(entry["cell"]["agent"])
        assert float(lines[0].split(" ±")[0]) == pytest.approx(entry["score"]["mean"], rel=0.1)
    assert not shown


def test_every_group_of_cells_has_a_figure_with_its_data_if_they_are_alike(release):
    cell = plan_benchmark("b1", Release.open(release), ["bc"])[0][0]
    point = {"step": 1, "loss": 1.0, "score": {"mean": 1.0, "stderr": 0.1}}
    cells = [replace(cell, setting=f"setting{number}") for number in range(3)]
    data = {"mean": 1.0, "limit": 500}
    results = [(cell, {"curve": [point], "data": data, "score": {"limit": 500 + i}}) for i, cell in enumerate(cells)]
    drawn = [figure.axes[1].get_lines() for figure in curve_figures(results, "smoke")]
    labels = [[line.get_label() for line in lines] for lines in drawn]
    assert ["data" in names for names in labels] == [True, False, False]  # only of like episodes


@pytest.fixture(scope="module")
def scored(small_release, tmp_path_factory):
    """Run a budget whose scores count into a folder: (agents, out, ...) -> the validation."""
    budget = replace(BUDGETS["smoke"], scores=True, readout_steps=0)

    def call(agents, out, release=small_release, only="*/*/none", **changes):
        options = dict(agents=agents) if agents else dict(checks_only=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(BUDGETS, "smoke", replace(budget, **changes))
            return validate(release, out=out, only=only, workers=1, **options)

    call.first = tmp_path_factory.mktemp("scored") / "report"
    call(["state-bc"], call.first)
    return call


def agents_of(out):
    return [one["cell"]["agent"] for one in json.loads((out / "report.json").read_text())["results"]]


def test_the_report_shows_what_lies_in_its_folder(scored, tmp_path):
    out = Path(shutil.copytree(scored.first, tmp_path / "out"))
    scored(["state-td3-bc"], out)
    assert agents_of(out) == ["state-td3-bc", "state-bc"]
    [policy] = (out / "cells").glob("*state-td3-bc*.safetensors")
    policy.unlink()
    scored(["state-td3-bc"], out)
    assert policy.exists()  # made again
    page = (out / "report.html").read_text()
    assert "state-bc" in page and "2 of 2 benchmark cells run" in page
    scored([], out)  # checks alone
    assert agents_of(out) == ["state-bc", "state-td3-bc"]
    [file] = (out / "cells").glob("*state-td3-bc*.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | {"fingerprint": "of other data"}))
    (out / "cells" / "x.json").write_text("no result")
    scored([], out)
    assert agents_of(out) == ["state-bc"]


def test_results_of_subsets_that_are_not_asked_for_stay_and_states_have_one_for_all_settings(scored, tmp_path):
    def shown():
        results = json.loads((out / "report.json").read_text())["results"]
        return {(one["cell"]["agent"], one["cell"]["setting"]): one["score"] for one in results}

    out = Path(shutil.copytree(scored.first, tmp_path / "out"))
    before = shown()
    scored(["state-td3-bc"], out, only="*/*/dynamic")
    assert shown().keys() == {("state-bc", "none"), ("state-td3-bc", "dynamic")}
    assert shown()["state-bc", "none"] == before["state-bc", "none"]
    scored(["state-bc"], out, only="*/*/dynamic")
    assert shown().keys() == {("state-bc", "dynamic"), ("state-td3-bc", "dynamic")}


def test_a_policy_is_not_evaluated_on_other_sizes_and_another_task_is_said(scored, caplog):
    agent = load_agent(scored.first / "cells" / "b1_walker-walk_none_state-bc_random.safetensors")
    with pytest.raises(DmcvbError, match="state has size 17 in cheetah-run, and the policy learned with 24"):
        dmcvb_gen.evaluate(agent, "cheetah-run/none")
    for task, told in (("walker-walk", []), ("walker-run", ["walker-walk, this one walker-run"])):
        dmcvb_gen.evaluate(agent, f"{task}/none", episodes=1, max_steps=1)
        assert [message.partition("has task ")[2] for message in caplog.messages] == told


def test_another_release_or_budget_means_another_folder(scored, small_mazes, tmp_path):
    out = Path(shutil.copytree(scored.first, tmp_path / "out"))
    before = (out / "report.json").read_text()
    for change, told in (
        ({"rate": 3.0}, r"profile smoke, seed 0 \(other budget.rate\); give another out"),
        ({"release": small_mazes, "only": "*/*/visible"}, r"holds results of release .* \(other release\)"),
    ):
        for agents in (["state-bc"], []):
            with pytest.raises(DmcvbError, match=told):
                scored(agents, out, **change)
    assert (out / "report.json").read_text() == before


@pytest.mark.slow
def test_a_release_that_grows_is_the_same_and_its_cells_are_made_again(scored, tmp_path):
    def grown(episodes):
        roll_out(short_recipe(settings="none", episodes_per_shard=1, episodes=episodes), tmp_path / "grows")

    grown(1)
    scored(["state-bc", "state-td3-bc"], tmp_path / "out", tmp_path / "grows")
    grown(2)
    scored(["state-bc"], tmp_path / "out", tmp_path / "grows")
    assert agents_of(tmp_path / "out") == ["state-bc"]
    [result] = json.loads((tmp_path / "out" / "report.json").read_text())["results"]
    assert result["episodes"] == 2


def test_bad_usage_ends_with_2_and_says_what_is_right(release, small_release, tmp_path):
    for arguments, message in (
        ((release, "--profile", "fast"), "paper, quick, smoke"),
        ((release, "--agents", "bcc"), "state-bc"),
        ((release, "--benchmark", "b3"), "roll out ant-maze-empty7x7/expert/fixed"),
        ((release, "--benchmark", "b2", "--agents", "td3-bc,id+bc"), "td3-bc has none; remove it"),
        ((release, "--only", "*/expert/*", "--benchmark", "b3"), "let --only take more subsets"),
        ((release, "--checks-only", "--benchmark", "b2"), "--benchmark has no effect"),
        ((release, "--agents", "dino+bc"), "--dino-weights"),
        ((small_release, "--only", "*/*/none", "--backgrounds", tmp_path), "--backgrounds has no effect"),
        ((tmp_path,), "no release"),
    ):
        result = invoke("validate", *arguments, "--out", tmp_path / "out", code=2)
        assert message in result.output, result.output
    assert not (tmp_path / "out").exists()
    for out in (release, release / "report"):
        told = invoke("validate", release, "--checks-only", "--out", out, code=2).output
        assert "lies in the release, which never changes; choose another --out" in told
    assert not (release / "report").exists()


@pytest.mark.slow
def test_a_damaged_release_ends_with_1_names_the_place_and_is_not_trained_on(copy, tmp_path):
    rewrite(copy, NAME, put("state", (1, 123, 4), np.nan))
    result = invoke("validate", copy, "--agents", "state-bc", "--out", tmp_path / "out", code=1)
    assert f"FAIL finite: {NAME}, episode 1, step 123" in result.output
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Checks failed: 1 finding" in page and "0 of 1 benchmark cells run" in page


def test_a_folder_that_cannot_be_written_is_refused_before_any_work(release, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("dmcvb_gen.benchmarks.checks.check_structure", lambda *_: pytest.fail("work was done"))
    result = invoke("validate", release, "--out", tmp_path / "file" / "report", code=2)
    assert "is a file; choose another place" in result.output


@pytest.mark.parametrize("name, words", [("budget.json", ["--agents=state-bc"]), ("report.json", ["--checks-only"])])
def test_a_full_disk_is_told_in_a_line(name, words, release, tmp_path, monkeypatch):
    def full(path, value):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr("dmcvb_gen.benchmarks.report.write_json", full)
    result = invoke("validate", release, *words, "--out", tmp_path / "out", code=2)
    assert f"no room to write to {tmp_path / 'out' / name}" in result.output


@pytest.mark.slow
def test_a_release_that_is_not_whole_is_called_so(small_release, tmp_path):
    part = shutil.copytree(small_release, tmp_path / "part")
    (part / record_path("walker-walk/random/none/labels", 1)).unlink()
    shutil.rmtree(part / "records" / "walker-walk" / "random" / "dynamic")
    for path in [part / "manifest.json", *part.rglob("zarr.json")]:
        path.unlink()  # as a rollout is left in the middle
    result = invoke("validate", part, "--checks-only", "--out", tmp_path / "out", code=1)
    assert "All checks passed" in result.output and "Incomplete: 5 of 9 episodes." in result.output
    facts = json.loads((tmp_path / "out" / "report.json").read_text())
    assert facts["sound"] and not facts["complete"]
    assert facts["incomplete"] == {"walker-walk/random/none": [2, 3], "walker-walk/random/dynamic": [0, 3]}
    assert "Incomplete: 5 of 9 episodes" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_imported_data_are_checked_trained_on_and_evaluated_by_our_renderer(small_release, tmp_path):
    only_dynamic = ("--only", "walker-walk/random/dynamic")
    invoke("export", small_release, *only_dynamic, "--to", "rlds", "--out", tmp_path / "rlds", code=0)
    [features] = (tmp_path / "rlds").rglob("features.json")
    shutil.copytree(features.parent, tmp_path / "locomotion/walker_walk/random/dynamic_medium")
    invoke("import", tmp_path / "locomotion", "--out", tmp_path / "release", code=0)
    options = ("--agents", "bc,state-bc", "--threads", 1, "--out", tmp_path / "out")
    invoke("validate", tmp_path / "release", *options, code=0)
    facts = json.loads((tmp_path / "out" / "report.json").read_text())
    assert facts["sound"] and {r["cell"]["agent"] for r in facts["results"]} == {"bc", "state-bc"}
    assert "The data were rendered elsewhere (imported)" in (tmp_path / "out" / "report.html").read_text()


def test_names_are_text_on_the_page(report):
    facts = json.loads((report[0] / "report.json").read_text())
    facts["release"]["name"], facts["results"] = "<script>alert(1)</script>", []
    page = render_page(facts, [], None)
    assert "<script>" not in page and "&lt;script&gt;alert(1)" in page


# -- policies that are kept: any score can be computed again, and hostile files make no network ------

SMALL = dict(network=PATCHES, episodes=3, evaluations=3)


@pytest.fixture(scope="module")
def walkers(scored, tmp_path_factory):
    out = tmp_path_factory.mktemp("walkers")
    scored(["state-bc", "td3-bc"], out, only="*/*/dynamic", **SMALL)
    return out


@pytest.fixture(scope="module")
def mazes(scored, small_mazes, tmp_path_factory):
    out = tmp_path_factory.mktemp("mazes")
    scored(["state-td3-bc", "id+bc"], out, small_mazes, only="*/*/visible", **SMALL)
    return out


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
        assert list(again.returns) == result["score"]["returns"], result["id"]
        assert dmcvb_gen.evaluate(agent, where, seed=1, **options).returns != again.returns
    assert len(results) == 2


def test_a_file_that_is_no_agent_is_refused(tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"not one")
    for name in ("x", "nothing"):
        with pytest.raises(DmcvbError, match="no agent that validate trained"):
            load_agent(tmp_path / f"{name}.safetensors")


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
    made, make_policy = [], catalog.make_policy

    def watched(*arguments):
        policy = make_policy(*arguments)
        made.append(next(policy.parameters()).device.type)
        return policy

    monkeypatch.setattr(catalog, "make_policy", watched)
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
    write_frames(tmp_path / "clips" / "val" / "one", [np.full((8, 8, 3), 200, np.uint8)], "png")
    dmcvb_gen.evaluate(agent, "walker-walk/dynamic", backgrounds=str(tmp_path / "clips"), **options)
    drawn = {"renderer": {"name": "opengl", "samples": 4}}
    elsewhere = replace(agent, evaluation=agent.evaluation | drawn)
    dmcvb_gen.evaluate(elsewhere, "walker-walk/dynamic", renderer="native", **options)
    videos, renderer = caplog.messages
    assert "has backgrounds" in videos and "has renderer" in renderer and "opengl" in renderer


# -- damage ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_returns_that_cannot_be_read_cost_no_report(small_mazes, tmp_path):
    """Of mazes, whose settings have returns of their own."""
    folder = shutil.copytree(small_mazes, tmp_path / "damaged")
    names = list(Release.open(folder).subsets)
    [layer] = [layer for layer in Release.open(folder)[names[0]].layers if layer.kind == "trajectories"]
    path = folder / layer.file_path(layer.array("return"), 0)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    rewrite(folder, names[1], lambda group: group["return"].__setitem__(0, np.nan))
    result = invoke("validate", folder, "--checks-only", "--out", tmp_path / "out", code=1)
    assert f"FAIL files: {names[0]}" in result.output, result.output
    assert f"FAIL returns: {names[1]}, episode 0" in result.output, result.output
    facts = json.loads((tmp_path / "out/report.json").read_text())
    assert list(facts["returns"]) == names[1:]
    left = Release.open(folder)[names[1]].returns[1:]
    assert facts["returns"][names[1]]["mean"] == pytest.approx(left.mean())
    assert "Checks failed" in (tmp_path / "out/report.html").read_text()


def test_black_pictures_fail_with_their_step_and_frozen_ones_are_a_warning(copy):
    rewrite(copy, NAME, put("pixels", (1, 77), 0))
    findings = checks.check_structure(Release.open(copy)).findings
    assert ("pictures", 1, 77) in {(one.check, one.episode, one.step) for one in findings}
    rewrite(copy, NAME, lambda group: group["pixels"].__setitem__(1, np.repeat(group["pixels"][1][:1], 501, axis=0)))
    findings, warnings = checks.check_pictures(Release.open(copy)[NAME])
    assert not findings and [(one.check, one.episode) for one in warnings] == [("pictures", 1)]


def seen_in(release, cells):
    """Subsets that are warned of because their data show what evaluation shows."""
    return {warning.subset for warning in checks.seen_warnings(release, cells, None)}


def test_data_that_show_what_evaluation_shows_are_warned_of(tmp_path, small_release, maze_release):
    """By the split that was asked for, or because a folder of one video has no other; states show neither."""
    write_frames(tmp_path / "one", [np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3)], "png")
    walker = dict(episodes=1, max_steps=3)
    seen = {
        "val": short_recipe(split="val", settings=["static", "none"], **walker),
        "one": short_recipe(backgrounds=str(tmp_path / "one"), settings="dynamic", **walker),
        "maze": maze_recipe(max_steps=3, split="val"),
    }
    for name, recipe in seen.items():
        roll_out(recipe, tmp_path / "made" / name)
        release = Release.open(tmp_path / "made" / name)
        cells, _ = plan_benchmark("b1", release, ["bc", "state-bc"])
        assert seen_in(release, cells) == {subset for subset in release.subsets if not subset.endswith("/none")}
        assert not seen_in(release, [cell for cell in cells if cell.agent.sees_state])
    release, names = Release.open(tmp_path / "made" / "val"), ("walker-walk/random/none", "walker-walk/random/static")
    cell = Cell("b2", "walker-walk", "none", parse_agent("id+bc"), *((Slice(name),) for name in names))
    assert seen_in(release, [cell]) == {names[1]}  # its encoder's
    for folder in (small_release, maze_release):
        release = Release.open(folder)
        assert not seen_in(release, plan_benchmark("b1", release, ["bc"])[0])


def with_policy(subset, task="walker-walk", **evaluation):
    policy = subset.record.policies[0]
    header = policy.header | {"task": task, "evaluation": policy.header["evaluation"] | evaluation}
    policies = (policy.model_copy(update={"header": header}),)
    subset.record = subset.record.model_copy(update={"policies": policies})
    return subset


def test_returns_unlike_the_policys_own_fail(release):
    subset = Release.open(release)[NAME]
    assert not list(checks.check_policy_returns(subset))
    [finding] = checks.check_policy_returns(with_policy(subset, mean=5000.0, std=5.0, mode="mean"))
    assert finding.check == "returns" and "its file says 5000.0" in finding.message
    assert not list(checks.check_policy_returns(with_policy(subset, mode="sampled")))  # not comparable
    elsewhere = with_policy(subset, "cheetah-run", mode="mean")
    assert not list(checks.check_policy_returns(elsewhere))  # an ant's policy in a maze where it was not measured


@pytest.mark.slow_cases("1")
@pytest.mark.parametrize("repeat", [1, 4])
def test_returns_of_actions_held_for_longer_are_compared_with_nothing(repeat, tmp_path):
    """At repeat 1 the policies hold their actions for two steps, as when they were measured."""
    roll_out(small_recipe(levels="expert", settings="none", episodes=4, action_repeat=repeat), tmp_path / "repeat")
    generator = torch.get_rng_state()
    result = validate(tmp_path / "repeat", out=tmp_path / "out", agents="state-bc", workers=1)
    assert torch.equal(torch.get_rng_state(), generator), "the caller's own numbers go on"
    facts = json.loads(result.facts.read_text())
    assert result.sound and not result.warnings, result.structure
    [returns], [score] = facts["returns"].values(), facts["results"]
    assert bool(returns["paper"]) == (repeat == 1) and score["paper"] is None
    [subset] = Release.open(tmp_path / "repeat").subsets.values()
    medium = subset.record.model_copy(update={"level": "medium", "setting": "static"})  # of which there are none
    assert bool(reference_returns(subset.release, medium)) == (repeat == 1)


def test_returns_unlike_the_papers_are_a_warning(release, small_release):
    assert not list(checks.check_paper_returns(Release.open(small_release)["walker-walk/random/none"]))
    subset = Release.open(release)[NAME]
    subset.__dict__["returns"] = np.array([400.0, 402.0])
    [finding] = checks.check_paper_returns(subset)
    assert finding.check == "paper" and "the paper's is 957.8" in finding.message


# -- mazes: goals visible, hidden, fixed ------------------------------------------------------------

MAZE = "ant-maze-tiny/random"


def test_episodes_of_fixed_goals_are_not_held_to_returns_over_random_ones(small_mazes):
    said = {"mean": -1.0, "std": 0.1, "episodes": 100, "mode": "sampled"}
    policy = PolicyRecord(name="other", digest="x", header={"task": TINY_MAZE, "evaluation": said})
    found = {}
    for setting in ("visible", "fixed"):
        subset = Release.open(small_mazes)[f"{MAZE}/{setting}"]
        whole = {"policies": (policy,), "deterministic": False, "max_steps": get_task(TINY_MAZE).max_steps}
        subset.record = subset.record.model_copy(update=whole)
        found[setting] = len(list(checks.check_policy_returns(subset)))
    assert found == {"visible": 1, "fixed": 0}


def test_the_cells_of_a_goal_pair_are_those_of_the_rollout(small_mazes):
    subset, layout = Release.open(small_mazes)[f"{MAZE}/fixed"], get_task(TINY_MAZE).layout
    assert [goal_cells(subset, pair) for pair in range(2)] == fixed_pairs(layout, 2, seed=3)


# -- B1 and B3 ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_maze_release_goes_through_b1_and_b3(small_mazes, tmp_path):
    command = ["validate", small_mazes, "--benchmark", "b1", "--benchmark", "b3", "--agents", "state-bc,bc,id+bc"]
    out = tmp_path / "out"
    result = invoke(*command, "--workers", 1, "--threads", 1, "--out", out, code=0)
    facts = json.loads((out / "report.json").read_text(), parse_constant=pytest.fail)  # a goal's one episode: no NaN
    ran = [(r["cell"]["benchmark"], r["cell"]["agent"], r["labels"]["policy"]) for r in facts["results"]]
    of_goals = {("b3", agent, f"random goal {pair}") for agent in ("bc", "id+bc") for pair in range(2)}
    assert set(ran) == {("b1", agent, "random") for agent in ("state-bc", "bc", "id+bc")} | of_goals
    by_id = {r["id"]: r for r in facts["results"]}
    pretrained = next(r for name, r in by_id.items() if name.startswith("b3") and "id-bc" in name.replace("+", "-"))
    assert [part["subset"] for part in pretrained["cell"]["pretrain"]] == [f"{MAZE}/hidden"]
    assert not facts["failed"] and not any(r["share"] for r in facts["results"])
    assert (out / "cells" / "b1_ant-maze-tiny_visible_bc_random.json").exists()  # rows may be longer than a file's name
    assert "ant-maze-tiny/expert/visible" in result.output  # B1 would have the paper's levels too
    page, reached = (out / "report.html").read_text(), Release.open(small_mazes)[f"{MAZE}/visible"].read("terminated")
    [scored] = [r for r in facts["results"] if r["cell"]["agent"] == "state-bc"]
    assert scored["data"]["success"] == reached.mean() and (scored["data"]["speed"] is None) == (not reached.any())
    assert scored["score"]["success"] is not None and "success" in page
    assert "Evaluations are cut at 10 agent steps, the data at 100." in page


def test_the_datas_speed_is_that_of_the_straight_line_as_the_policies_is(small_mazes):
    subset, task = Release.open(small_mazes)[f"{MAZE}/visible"], get_task(TINY_MAZE)
    data = load_data({subset.name: subset}, [Slice(subset.name)], pixels=False, seed=0)
    data.discount[np.cumsum(data.lengths + 1) - 2] = 0  # as if the ant had got there
    straight = np.linalg.norm(subset.read("state")[:, 0, task.state_slices["target_vector"]], axis=1)
    score = data_score(subset, data)
    assert score.success == 1
    assert score.speed == pytest.approx((straight / (data.lengths * 2 * task.control_timestep)).mean(), rel=1e-4)
