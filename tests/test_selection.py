"""Picking checkpoints from curves whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dmcvb_gen.behaviours.policy_file import Evaluation
from dmcvb_gen.behaviours.selection import MIXED_COUNT, converge, pick_checkpoints

STEPS = np.arange(1, 101) * 1000


def rising(top=1000.0, at=40, base=0.0):
    """A line from base to top, then a plateau."""
    return base + (top - base) * np.minimum(np.arange(1, 101) / at, 1)


def select(returns, base=0.0, noise=0.0, fresh=None):
    """Select from a synthetic curve; fresh episodes return the true value (or `fresh`)."""
    rng = np.random.default_rng(0)
    seen = returns + noise * rng.normal(size=len(returns))
    curve = [
        (int(step), float(value), Path(f"{index}"))
        for index, (step, value) in enumerate(zip(STEPS, seen, strict=False))
    ]
    truth = returns if fresh is None else fresh

    def measure(path):
        value = float(truth[int(path.name)])
        return Evaluation(mean=value, std=abs(noise), episodes=100, mode="sampled", seed=0)

    return pick_checkpoints(curve, base, converge([p[0] for p in curve], seen, base), measure)


def test_a_monotone_curve_gives_the_first_at_95_and_the_one_at_50():
    found = select(rising())
    assert found.convergence.converged and found.convergence.value == pytest.approx(1000, rel=0.01)
    assert found.picks["expert"][0].step == 38_000 and found.picks["medium"][0].step == 20_000
    mixed = [pick.evaluation.mean for pick in found.picks["mixed"]]
    assert len(mixed) == MIXED_COUNT
    np.testing.assert_allclose(mixed, np.linspace(0, 500, MIXED_COUNT), atol=30)
    assert found.reasons == {}


def test_noise_moves_the_picks_little_and_fresh_episodes_decide():
    found = select(rising(), noise=30.0)
    assert 37_000 <= found.picks["expert"][0].step <= 44_000
    assert found.picks["expert"][0].evaluation.mean >= 0.95 * found.convergence.value
    assert abs(found.picks["medium"][0].evaluation.mean / found.convergence.value - 0.5) <= 0.1


def test_lucky_evaluations_do_not_make_an_expert():
    seen, truth = rising(), rising()
    seen[20:25] = 1000  # twenty lucky episodes; fresh ones say half
    found = select(seen, fresh=truth)
    assert found.picks["expert"][0].step == 38_000


def test_a_plateau_before_the_top_is_not_convergence_of_the_whole():
    returns = np.concatenate([np.full(40, 300.0), np.linspace(300, 1000, 20), np.full(40, 1000.0)])
    found = select(returns)
    assert found.convergence.value == pytest.approx(1000, rel=0.01) and found.picks["expert"][0].step >= 58_000


def test_a_collapse_after_the_peak_keeps_the_peak():
    returns = np.concatenate([rising()[:40], np.full(35, 1000.0), np.linspace(1000, 50, 25)])
    found = select(returns)
    assert found.convergence.value == pytest.approx(1000, rel=0.01) and found.picks["expert"][0].step == 38_000


def test_negative_returns_count_from_the_random_policy():
    found = select(rising(top=-50.0, base=-450.0), base=-450.0)
    assert found.convergence.value == pytest.approx(-50, abs=2)
    assert found.picks["expert"][0].evaluation.mean >= -50 - 0.05 * 400 - 1
    assert found.picks["medium"][0].evaluation.mean == pytest.approx(-250, abs=41)


def test_a_curve_that_still_rises_has_no_expert_yet_and_says_so():
    found = select(np.linspace(10, 1000, 100))
    assert not found.convergence.converged and "still rises" in found.reasons["expert"]
    assert "medium" in found.picks


def test_a_short_run_has_nothing_yet():
    found = select(rising()[:5])
    assert "5 evaluations" in found.reasons["expert"] and "expert" not in found.picks


def test_a_run_that_never_left_the_floor_has_nothing():
    found = select(np.full(100, -3.0))
    assert found.picks == {} and "never rose" in found.reasons["medium"]


def test_a_jump_over_the_half_says_what_is_missing():
    returns = np.concatenate([np.full(30, 20.0), np.full(70, 1000.0)])
    found = select(returns)
    assert "expert" in found.picks and "evaluate more often" in found.reasons["medium"]
    assert "evaluate more often" in found.reasons["mixed"]
