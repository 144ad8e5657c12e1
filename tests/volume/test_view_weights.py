"""Weights of views that can make each other's paths, against their definitions: exact, no
renderer."""

from mis_integrators.weights.multiview import HEURISTICS, gain, summand

import numpy as np
import pytest


def densities(seed):
    """Densities p_k of five views for the versions x_k of 40 paths, in the domain of one of them;
    some views cannot make some of the paths."""
    rng = np.random.default_rng(seed)
    p = rng.lognormal(0, 2, (5, 40)) * (rng.uniform(size=(5, 40)) > 0.3)
    p[0] = np.maximum(p[0], 1e-3)
    return p


def weights(heuristic, p, exponent=2.0):
    """w_{i->j} (i, path) by the functions: the gain r_j / total over r_j, for every view i that can
    make the path; whichever j."""
    found = np.zeros_like(p)
    for i in range(len(p)):
        can = p[i] > 0
        ratio = p[:, can] / p[i, can]
        total = sum(np.where(r > 0, summand(heuristic, r, exponent), 0) for r in ratio)
        for r in ratio:
            sees = r > 0
            found[i, np.flatnonzero(can)[sees]] = gain(r[sees], total[sees]) / r[sees]
    return found


@pytest.mark.parametrize("heuristic", HEURISTICS)
def test_weights_sum_to_one(heuristic):
    """Over the views that can make a path, whatever their densities: so the estimator is
    unbiased."""
    assert np.allclose(weights(heuristic, densities(1)).sum(axis=0), 1)


def test_definitions():
    p = densities(2)
    assert np.allclose(weights("mis", p), p / p.sum(axis=0))
    assert np.allclose(weights("power", p), p**2 / (p**2).sum(axis=0))
    for exponent in (1.0, 1.5, 4.0, 8.0):
        q = p**exponent
        assert np.allclose(weights("power", p, exponent), q / q.sum(axis=0), rtol=1e-4)
    # Beyond single precision a view's ratio counts as infinite: finite sums, and no share for it.
    huge = summand("power", np.float32([1e15, 1.0]), 8.0)
    assert np.all(np.isfinite(100 * huge.astype(np.float32))) and huge[1] == 1
    assert np.allclose(weights("none", p), (p > 0) / (p > 0).sum(axis=0))
    # MWIS: what arrives in view j is w f/p_jj with w = (1/S) p_jj/p_ij, the very gain of MIS; its
    # sum over paths is expected to be one.
    i, j = 0, 3
    ratio = p[:, p[j] > 0] / p[i, p[j] > 0]
    total = ratio.sum(axis=0)
    assert np.allclose(gain(ratio[j], total), (1 / total) * ratio[j]) and np.allclose(
        summand("mwis", ratio), ratio
    )
