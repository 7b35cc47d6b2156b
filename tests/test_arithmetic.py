"""Functions of our own against numpy's and scipy's."""

import numpy as np
import pytest
from scipy import stats

from dmcvb_gen import arithmetic

GRID = np.random.default_rng(0).normal(size=20_000) * np.repeat([1e-8, 0.01, 1.0, 30.0], 5000)


def test_functions_are_numpys_to_the_last_bits():
    np.testing.assert_allclose(arithmetic.exp(GRID), np.exp(GRID), rtol=2e-15, atol=2e-16)
    np.testing.assert_allclose(arithmetic.sin_cos(GRID), (np.sin(GRID), np.cos(GRID)), rtol=2e-15, atol=2e-16)
    np.testing.assert_allclose(arithmetic.tanh(GRID), np.tanh(GRID), rtol=0, atol=2.5e-16)
    positive = np.abs(GRID) + 1e-300
    np.testing.assert_allclose(arithmetic.log(positive), np.log(positive), rtol=1e-15, atol=1e-16)
    other = GRID[::-1]
    np.testing.assert_allclose(arithmetic.arctan2(GRID, other), np.arctan2(GRID, other), rtol=1e-15, atol=1e-300)


def test_ends_of_the_range():
    np.testing.assert_array_equal(arithmetic.exp([-800.0, 0.0, 800.0, -np.inf]), [0, 1, np.inf, 0])
    np.testing.assert_array_equal(arithmetic.tanh([-400.0, -0.0, 0.0, 400.0]), [-1, 0, 0, 1])
    down, across = [0.0, 0, -0.0, 1, -1], [0.0, -1, -1, 0, 0]
    np.testing.assert_array_equal(arithmetic.arctan2(down, across), np.arctan2(down, across))
    assert float(arithmetic.exp(1.0)) == pytest.approx(np.e, rel=4e-16)


def test_lengths():
    vectors = np.random.default_rng(1).normal(size=(50, 3, 4))
    for axis in (0, 1, -1):
        np.testing.assert_allclose(arithmetic.norm(vectors, axis), np.linalg.norm(vectors, axis=axis), rtol=1e-15)
    assert arithmetic.norm(vectors, 1, keepdims=True).shape == (50, 1, 4)


def test_normal_numbers_are_normal_and_independent():
    draws = arithmetic.normal(np.random.default_rng(0), (40_000, 5))
    assert stats.kstest(draws.ravel(), "norm").pvalue > 0.01
    assert np.abs(np.corrcoef(draws.T) - np.eye(5)).max() < 0.02
    assert arithmetic.normal(np.random.default_rng(0), (3, 3)).shape == (3, 3)
    few, many = (arithmetic.normal(np.random.default_rng(0), (count, 3)) for count in (3, 8))
    np.testing.assert_array_equal(few, many[:3])
