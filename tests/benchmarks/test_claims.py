"""The paper's claims on made-up scores whose answers are known, and of a report that `validate` wrote."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from dmcvb_gen.benchmarks.agreement import rank_agreement, shared_cells
from dmcvb_gen.benchmarks.claims import judge, pool, read_reports
from dmcvb_gen.cli import main
from dmcvb_gen.errors import DmcvbError


def result(agent, setting, returns, *, benchmark="b1", learns="expert", encoder="", data=100.0, scores=True, **more):
    """A result as `report.json` has it, with what questions are asked of."""
    cell = {"benchmark": benchmark, "task": "walker-walk", "setting": setting, "agent_name": agent}
    cell |= {"policy_label": learns, "pretrain_label": encoder}
    facts = {"cell": cell, "score": {"returns": returns, "limit": 500}, "data": {"mean": data, "limit": 500}}
    return facts | {"profile": {"scores": scores}, "episodes": 3, "seed": 0, "digests": {"one": "d1"}} | more


def near(mean):
    return [mean - 1.0, mean, mean + 1.0]


def answers_of(*results):
    return {(answer.claim, answer.where): answer.answer for answer in judge(results)}


def test_order_is_asked_of_settings_that_follow_each_other():
    found = answers_of(
        result("bc", "none", near(90)), result("bc", "static", near(91)), result("bc", "dynamic", near(20))
    )
    assert list(found.values()) == ["open", "yes"]
    assert list(answers_of(result("bc", "none", near(20)), result("bc", "dynamic", near(90))).values()) == ["no"]


def test_states_near_their_data():
    where = ("state", "walker-walk expert")
    assert answers_of(result("state-bc", "none", near(97)))[where] == "yes"
    assert answers_of(result("state-bc", "none", near(80)))[where] == "no"
    assert answers_of(result("state-bc", "none", [20.0, 160.0, 90.0]))[where] == "open"  # 10 below, but 40 uncertain
    assert answers_of(result("state-bc", "none", near(-101), data=-100.0))[where] == "yes"


@pytest.mark.parametrize("mean, error, answer", [(902, 15, "open"), (880, 30, "open"), (905, 40, "open"),
                                                 (935, 10, "yes"), (870, 10, "no")])  # fmt: skip
def test_the_edge_of_near_counts_from_two_errors_on(mean, error, answer):
    returns = [mean - error * 3**0.5, mean, mean + error * 3**0.5]  # whose mean has that standard error
    found = judge([result("state-bc", "none", returns, data=950.0)])
    assert [one.answer for one in found if one.claim == "state"] == [answer]


def test_returns_of_episodes_cut_elsewhere_are_not_compared_with_their_data():
    cut_at_twice_that = {"score": {"returns": near(-80), "limit": 1200}}
    [answer] = judge([result("state-bc", "visible", [], data=-100.0, **cut_at_twice_that)])
    assert answer.answer == "open" and "cut at other lengths" in answer.numbers


def test_id_is_compared_with_pictures_alone_and_not_without_distractors():
    found = answers_of(
        *(result(agent, "dynamic", near(mean)) for agent, mean in (("id+bc", 50), ("bc", 60), ("lfd+bc", 20))),
        *(result(agent, "none", near(mean)) for agent, mean in (("id+bc", 99), ("bc", 60), ("state-bc", 97))),
    )
    assert {where.rpartition(", ")[2]: answer for (question, where), answer in found.items() if question == "id"} == {
        "id+bc over bc": "no",
        "id+bc over lfd+bc": "yes",
    }
    every = judge([result("id+bc", "dynamic", near(50)), result("state-bc", "dynamic", near(97))])
    assert not [answer for answer in every if answer.claim == "id"]


def test_the_gap_to_states_is_of_every_setting():
    found = judge([result("state-bc", "none", near(97)), *(result("bc", s, near(60)) for s in ("none", "dynamic"))])
    assert [answer.answer for answer in found if answer.claim == "gap"] == ["yes", "yes"]


@pytest.mark.parametrize("benchmark, question", [("b2", "mixed"), ("b3", "goals")])
def test_an_encoder_from_other_data_is_compared_with_bc_on_the_same_episodes(benchmark, question):
    own = dict(benchmark=benchmark, learns="20 expert")
    found = judge(
        [
            result("bc", "none", near(40), **own),
            result("bc", "none", near(90), benchmark=benchmark, learns="expert"),
            result("id+bc", "none", near(70), encoder="mixed", **own),
        ]
    )
    assert [(answer.claim, answer.answer) for answer in found] == [(question, "yes")]
    assert "70.0" in found[0].numbers and "40.0" in found[0].numbers


def test_goals_are_compared_one_by_one_and_as_their_mean():
    def of(agent, *means, encoder=""):
        made = dict(benchmark="b3", encoder=encoder)
        goals = enumerate(means)
        return [result(agent, "fixed", near(mean), learns=f"expert goal {goal}", **made) for goal, mean in goals]

    found = judge(of("bc", 40, 42) + of("bc+bc", 70, 41, encoder="expert") + of("id+bc", 50, 43, encoder="expert"))
    means = {answer.claim: answer for answer in found if "expert, mean of 2 goals (encoder: expert)" in answer.where}
    assert len(found) == 6 + 3 and set(means) == {"goals", "encoders"}
    assert means["encoders"].answer == "yes" and "difference +9.0 +- 0.6" in means["encoders"].numbers
    alone = [answer.answer for answer in found if answer.claim == "encoders" and "mean" not in answer.where]
    assert alone == ["yes", "no"]
    [only] = judge(of("bc", 40) + of("bc+bc", 70, encoder="expert"))
    assert "mean" not in only.where


def test_means_over_other_goals_are_not_compared():
    def of(agent, means, encoder=""):
        made = dict(benchmark="b3", encoder=encoder)
        return [result(agent, "fixed", near(m), learns=f"expert goal {goal}", **made) for goal, m in means.items()]

    id_bc = of("id+bc", {0: 50, 1: 43}, "expert")
    found = judge(of("bc", {0: 40, 1: 42, 2: 1}) + of("bc+bc", {1: 41, 2: 90}, "expert") + id_bc)
    assert len(found) == 2 + 2 + 1 and not [answer for answer in found if "mean" in answer.where]
    same = judge(of("bc+bc", {0: 41, 1: 90}, "expert") + id_bc + of("bc", {0: 40, 1: 42, 2: 1}))
    [mean] = [answer for answer in same if "mean" in answer.where]
    assert mean.claim == "encoders" and "mean of goals 0, 1 (encoder: expert)" in mean.where


def test_shares_are_compared_in_their_order():
    made = [result("bc", "none", near(mean), benchmark="ablations", learns=label) for mean, label in
            ((80, "expert"), (20, "1% expert"), (81, "25% expert"), (40, "5% expert"))]  # fmt: skip
    assert [answer.answer for answer in judge(made)] == ["yes", "yes", "open"]


def test_seeds_that_lie_apart_widen_the_error():
    one, two = result("bc", "none", near(50)), result("bc", "none", near(90))
    (score,) = pool([one, two]).values()
    assert score.mean == 70 and score.seeds == (50, 90) and score.stderr == pytest.approx(20)
    (alone,) = pool([one]).values()
    assert alone.stderr == pytest.approx(1 / 3**0.5)


def test_starts_that_all_seeds_share_do_not_average_out():
    rng, errors, means = np.random.default_rng(0), [], []
    for _ in range(200):
        starts = rng.normal(0, 100, 30)
        (score,) = pool(result("bc", "none", list(starts + rng.normal(0, 30, 30))) for _ in range(5)).values()
        errors.append(score.stderr)
        means.append(score.mean)
    assert np.mean(errors) == pytest.approx(np.std(means), rel=0.15)


def test_numbers_that_claim_no_score_answer_nothing():
    assert judge([result("state-bc", "none", near(97), scores=False)]) == []


def write(folder, profile, *results, release="walkers", **values):
    folder.mkdir(parents=True)
    marked = [one | {"fingerprint": f"{folder}, {index}"} for index, one in enumerate(results)]
    facts = {"profile": {"name": profile} | values, "results": marked, "release": {"name": release, "version": "1.0.0"}}
    facts |= {"settings": {"seed": 0}}
    (folder / "report.json").write_text(json.dumps(facts))
    return str(folder)


def test_command(tmp_path):
    both = [write(tmp_path / str(i), "quick", result("state-bc", "none", near(98 + i), seed=i)) for i in (0, 1)]
    shown = CliRunner().invoke(main, ["questions", *both])
    assert shown.exit_code == 0 and "seeds: 98.0, 99.0" in shown.output and "  yes  walker-walk expert" in shown.output
    facts = json.loads(CliRunner().invoke(main, ["questions", *both, "--json"]).output)
    assert facts["scores"][0]["seeds"] == [98, 99] and facts["answers"][0]["answer"] == "yes"
    assert len(read_reports([*both, both[0]])) == 2  # a report that is named twice is no second seed
    other = write(tmp_path / "other", "paper", result("state-bc", "none", near(97)))
    elsewhere = write(tmp_path / "elsewhere", "quick", result("bc", "none", near(1)), release="cheetahs")
    assert len(read_reports([*both, elsewhere])) == 3
    data = write(tmp_path / "data", "quick", result("state-bc", "none", near(97), seed=2), release="cheetahs")
    with pytest.raises(DmcvbError, match="cannot be pooled: cheetahs 1.0.0, 3 episodes; walkers 1.0.0"):
        read_reports([*both, data])
    grown = write(tmp_path / "grown", "quick", result("state-bc", "none", near(97), seed=2, digests={"one": "d2"}))
    with pytest.raises(DmcvbError, match="cannot be pooled: walkers 1.0.0, digest d1; walkers 1.0.0, digest d2"):
        read_reports([*both, grown])
    again = write(tmp_path / "again", "quick", result("state-bc", "none", near(97), seed=1))
    with pytest.raises(DmcvbError, match=r"walker-walk expert, none twice with seed 1, in .*1, .*again; a second"):
        read_reports([*both, again])
    refused = CliRunner().invoke(main, ["questions", *both, other])
    assert refused.exit_code == 2 and "different profiles" in refused.output and refused.output.count("\n") == 1


def test_budgets_of_one_name_and_evaluations_that_differ_are_one_line(tmp_path):
    def refused(name, one, other, told):
        """Two reports, (returns, the result's facts, the profile's) each."""
        folders = [
            write(tmp_path / name / str(seed), "quick", result("bc", "none", returns, seed=seed, **facts), **profile)
            for seed, (returns, facts, profile) in enumerate((one, other))
        ]
        done = CliRunner().invoke(main, ["claims", *folders])
        assert done.exit_code == 2 and told in done.output.replace("\n", " "), done.output
        assert "Traceback" not in done.output and done.output.count("\n") <= 2

    plain = (near(50), {}, {"rate": 1.0, "note": "a"})
    refused("budget", plain, (near(50), {}, {"rate": 2.0}), "0 (rate 1.0), ")
    refused("count", plain, ([1.0, 2.0], {}, {}), "(episodes 2)")
    one, other = ({"evaluation": {"steps": steps, "goals": None}} for steps in (500, 100))
    refused("cut", (near(50), one, {}), (near(50), other, {}), "(steps 100)")
    fits = [
        write(tmp_path / "fits" / str(seed), "quick", result("bc", "none", near(9), seed=seed, **facts), **profile)
        for seed, (facts, profile) in enumerate([({}, {"note": "a", "rate": 1.0}), (one, {"note": "b"})])
    ]
    assert len(read_reports(fits)) == 2  # a note decides nothing, and earlier versions said less


@pytest.mark.parametrize(
    "results, told",
    [
        ([], "hold no results"),
        ([result("bc", "none", [1.0, 2.0, 3.0], scores=False)], "use --profile brief"),
        ([result("bc", "none", [1.0, 2.0, 3.0])], "No two scores of these reports answer a claim"),
    ],
)
def test_reports_that_answer_nothing_are_told_why(tmp_path, results, told):
    done = CliRunner().invoke(main, ["claims", write(tmp_path / "report", "quick", *results)])
    assert done.exit_code == 0 and told in done.output and ("--profile" in told or "--profile" not in done.output)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"profile": {"name": "quick"}}', "\0"])
def test_what_is_no_report_is_one_line(tmp_path, text):
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(DmcvbError, match="validate writes it"):
        read_reports([tmp_path])


def test_agents_trained_on_other_data_are_not_compared(tmp_path):
    for folder, agent, digest in (("a", "bc", "d1"), ("b", "id+bc", "d2"), ("c", "id+bc", "d1")):
        facts = {"release": {"name": "mini", "version": "1.0.0"}, "profile": {"name": "brief"}, "settings": {"seed": 0}}
        one = result(agent, "static", near(50), digests={"walker-walk/expert/static": digest}, fingerprint=folder)
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "report.json").write_text(json.dumps(facts | {"results": [one]}))
    assert len(read_reports([tmp_path / "a", tmp_path / "c"])) == 2
    with pytest.raises(DmcvbError, match="different data"):
        read_reports([tmp_path / "a", tmp_path / "b"])


# -- rank agreement ---------------------------------------------------------------------------------


def beside(task, agent, share, paper, setting="none", spread=0.01, seed=0, **more):
    """A result of expert data that scored `share` of it, where the paper's table has `paper`."""
    returns = [100 * (share - spread), 100 * share, 100 * (share + spread)]
    facts = result(agent, setting, returns, seed=seed, **more)
    facts["cell"]["task"] = task
    return facts | {"paper": {"mean": paper, "stderr": 1}}


def test_scores_ranked_as_the_papers_agree_and_reversed_ones_do_not():
    shares = {"bc": (0.9, 900), "id+bc": (0.7, 800), "ae+bc": (0.5, 500), "lfd+bc": (0.1, 60)}
    alike = shared_cells([beside("walker-walk", agent, *values) for agent, values in shares.items()])
    [found] = rank_agreement(alike)
    assert (found.rho, found.cells, found.task) == (1.0, 4, "walker-walk") and found.low == found.high == 1.0
    reverse = zip(shares, [0.1, 0.5, 0.7, 0.9], [paper for _, paper in shares.values()], strict=True)
    assert rank_agreement(shared_cells([beside("walker-walk", *row) for row in reverse]))[0].rho == -1.0


def test_rho_is_of_shares_of_the_data_by_task_and_together_with_an_interval():
    """By hand: walker's data returned 958, cheetah's 890, humanoid's 766 in the paper, ours 100 throughout."""
    papers = {"walker-walk": 958, "cheetah-run": 890, "humanoid-walk": 766}
    rows = [("bc", 0.9, 0.85), ("id+bc", 0.5, 0.6), ("ae+bc", 0.51, 0.3), ("lfd+bc", 0.1, 0.1)]
    results = [
        beside(task, agent, share, paper * data, spread=0.05, seed=seed)
        for task, data in papers.items()
        for agent, share, paper in rows
        for seed in (0, 1)
    ]
    pairs = shared_cells(results)
    assert len(pairs) == 12 and all(len(pair.returns) == 3 for pair in pairs)
    assert {round(pair.paper, 6) for pair in pairs} == {0.85, 0.6, 0.3, 0.1}
    found = {one.task: one for one in rank_agreement(pairs)}
    assert set(found) == {*papers, "all tasks"} and found["all tasks"].cells == 12
    assert found["walker-walk"].rho == pytest.approx(0.8)  # one swap of neighbors of four: 1 - 6 * 2 / (4 * 15)
    assert found["walker-walk"].low <= 0.8 <= found["walker-walk"].high and found["walker-walk"].high == 1.0


def test_seeds_that_fall_at_the_same_starts_make_no_interval_narrower():
    rows = [("bc", 0.6, 900), ("id+bc", 0.55, 800), ("ae+bc", 0.5, 500), ("lfd+bc", 0.45, 60)]

    def interval(*spreads):
        """The returns of each seed lie so far from their mean at the first and the last start."""
        seeds = enumerate(spreads)
        results = [beside("walker-walk", *row, spread=spread, seed=seed) for seed, spread in seeds for row in rows]
        [found] = rank_agreement(shared_cells(results))
        return found.low, found.high

    once = interval(0.3)
    assert once == interval(0.3, 0.3, 0.3, 0.3, 0.3) and once[0] < once[1]
    assert interval(0.3, -0.3) == (1.0, 1.0)  # what one seed loses at a start, the other one wins


def test_returns_of_episodes_that_were_cut_elsewhere_are_not_ranked():
    cells = [beside("walker-walk", agent, 0.5, 500) for agent in ("bc", "id+bc", "ae+bc")]
    assert len(shared_cells(cells)) == 3
    for cell in cells:
        cell["score"]["limit"], cell["data"]["limit"] = 500, 30
    assert not shared_cells(cells)


def test_noise_and_cells_that_the_paper_lacks_are_not_ranked():
    cells = [beside("walker-walk", agent, 0.5, 500, scores=False) for agent in ("bc", "id+bc", "ae+bc")]
    assert not shared_cells(cells)
    assert not shared_cells([result("bc", "none", near(90)) | {"paper": None}])
    assert not rank_agreement(shared_cells([beside("walker-walk", "bc", 0.5, 500)]))  # one cell has no rank
