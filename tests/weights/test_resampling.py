"""Resampled light sub-paths on discrete worlds whose every outcome can be counted.

With `--vectors DIR` the worlds and answers of DIR/resampling.json are used; else worlds generated
here, their answers by enumeration.
"""

import itertools
import json
from pathlib import Path

from mis_integrators.weights import resampling

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

GENERATED = [
    (seed, M, N, states)
    for seed, (M, N, states) in enumerate(
        (M, N, states)
        for M in (1, 2, 3)
        for N in (1, 3)
        for states in ((2,), (3, 2), (2, 2, 2))
        if M * sum(states) <= 12
    )
]


def random_world(seed, M, N, states):
    """A discrete world as in the vectors: densities p, contributions g and targets q* for each
    length and state."""
    rng = np.random.default_rng(seed)
    p = [rng.dirichlet(np.ones(n)) + 1e-3 for n in states]
    return {
        "M": M,
        "N": N,
        "p": [x / x.sum() for x in p],
        "g": [rng.uniform(0, 2, n) for n in states],
        "q_star": [rng.uniform(0.1, 2, n) for n in states],
    }


def enumerate_world(world, uniform=0.0, cached=None):
    """Mean and variance of the resampling estimate over every outcome; `cached`: targets that the
    pmf is made of instead of the world's."""
    M, N, p, g = world["M"], world["N"], world["p"], world["g"]
    r = [resampling.proposal_weight(np.asarray(q), x) for q, x in zip(cached or world["q_star"], p)]
    mean = square = 0.0
    for outcome in itertools.product(*[range(len(x)) for x in p for _ in range(M)]):
        place = [(s, state) for s, state in zip(np.repeat(np.arange(len(p)), M), outcome)]
        probability = np.prod([p[s][i] for s, i in place])
        ratios = np.array([r[s][i] for s, i in place])
        pmf = resampling.pmf(ratios, ratios.sum(), len(place), uniform)
        assert pmf.sum() == pytest.approx(1, abs=1e-12)
        said = resampling.estimate(
            np.array([g[s][i] for s, i in place]), np.array([p[s][i] for s, i in place]), pmf, M
        )
        first, second = np.sum(pmf * said), np.sum(pmf * said**2)
        mean += probability * first
        square += probability * ((second - first**2) / N + first**2)
    return mean, square - mean**2


def countable(world):
    """Whether the outcomes are few enough to go through."""
    return np.prod([float(len(x)) ** world["M"] for x in world["p"]]) <= 1e5


def pytest_generate_tests(metafunc):
    if "world" in metafunc.fixturenames:
        directory = metafunc.config.getoption("vectors")
        if directory is None:
            worlds, names = (
                [random_world(*case) for case in GENERATED],
                [f"M{M}-N{N}-{states}" for _, M, N, states in GENERATED],
            )
        else:
            file = Path(directory) / "resampling.json"
            # other kinds of vectors are no business of these tests
            worlds = json.loads(file.read_text()) if file.exists() else []
            names = [str(i) for i in range(len(worlds))]
        metafunc.parametrize(
            "world",
            [
                {
                    key: [np.array(x) for x in value] if isinstance(value, list) else value
                    for key, value in world.items()
                }
                for world in worlds
            ],
            ids=names,
        )


def variance(world, dtype=np.float64):
    lists = [[x.astype(dtype) for x in world[key]] for key in ("g", "p", "q_star")]
    return resampling.estimate_variance(*lists, world["M"], world["N"], np.sum)


def moment(world, g=None):
    return resampling.second_moment(
        g or world["g"], world["p"], world["q_star"], world["M"], world["N"], np.sum
    )


# --- exact worlds -------------------------------------------------------------


def test_variance_is_exact(world):
    total = sum(g.sum() for g in world["g"])
    if "variance" in world:
        assert variance(world) == pytest.approx(world["variance"], rel=1e-9)
        assert total == pytest.approx(world["mean"], rel=1e-9)
    if countable(world):
        assert enumerate_world(world) == pytest.approx((total, variance(world)), rel=1e-9)


@pytest.mark.parametrize("M, N", [(1, 1), (2, 1), (2, 3)])
def test_variance_over_camera_paths_is_exact(M, N):
    """Three camera sub-paths with worlds of their own, of which one is drawn: equations 29 to 32
    against the mean and second moment over every outcome."""
    p_camera = np.array([0.2, 0.5, 0.3])
    worlds = [random_world(seed, M, N, (3, 2)) for seed in (20, 21, 22)]
    outcomes = np.array([enumerate_world(world) for world in worlds])
    mean = outcomes[:, 0].sum()
    # Each camera sub-path's estimate is divided by p(Z), and made with that probability.
    square = np.sum((outcomes[:, 1] + outcomes[:, 0] ** 2) / p_camera)
    found = resampling.variance_over_camera_paths(
        np.array([variance(world) for world in worlds]),
        np.array([sum(g.sum() for g in world["g"]) for world in worlds]),
        p_camera,
        np.sum,
    )
    assert found == pytest.approx(square - mean**2, rel=1e-9)


def test_cache_points_share_one_technique():
    """N_c cache points and the virtual one, all with the same target and pmf, are one technique:
    their gains add up to that without cache points."""
    neighbors, M, share, ends = 3, 20, 0.4, 2.5
    ratio = resampling.uniform_density_ratio(ends)
    assert ratio == pytest.approx(M * 1 / (M * ends))  # M P_r, of a uniform P_r
    alone = resampling.gain(ratio, share, M)
    chance = resampling.cache_point_probability(neighbors)
    assert (neighbors + 1) * chance * alone == pytest.approx(alone)


def test_densities_are_those_of_the_variance(world):
    """The variance is the integral of g^2/p_t less squares of integrals: that is where p_t comes
    from."""
    totals, M, N = np.array([g.sum() for g in world["g"]]), world["M"], world["N"]
    squares = np.sum(totals**2) / M * (1 - 1 / N) + totals.sum() ** 2 / N
    assert moment(world) - squares == pytest.approx(variance(world), rel=1e-9)


def test_any_pmf_is_unbiased(world):
    """A pmf of another target, with zeros where there is light: the uniform share keeps the
    mean."""
    if not countable(world):
        return
    rng = np.random.default_rng(1)
    cached = [q * rng.choice([0, 0.1, 3], len(q)) for q in world["q_star"]]
    expected = sum(g.sum() for g in world["g"])
    assert enumerate_world(world, 0.1, cached)[0] == pytest.approx(expected, rel=1e-9)
    assert enumerate_world(world, 0.1, [0 * q for q in cached])[0] == pytest.approx(
        expected, rel=1e-9
    )


def test_weights_are_the_best(world):
    """Resampled techniques and an ordinary one share the light f: no other weights have a lower sum
    of second moments."""
    rng = np.random.default_rng(2)
    M, N, p, q_star = world["M"], world["N"], world["p"], world["q_star"]
    f, other, count = world["g"], [rng.uniform(0.05, 1, len(x)) for x in p], 7
    Q = sum(x.sum() for x in q_star)
    own = [resampling.resampled_density(a, b / Q, b.sum() / Q, M, N) for a, b in zip(p, q_star)]
    weights = [resampling.technique_weights([a, b], [1, count]) for a, b in zip(own, other)]
    assert all(np.allclose(a + b, 1, atol=1e-14) for a, b in weights)

    def noise(resampled):
        ordinary = (
            sum(np.sum(((1 - w) * x) ** 2 / d) for w, x, d in zip(resampled, f, other)) / count
        )
        return moment(world, [w * x for w, x in zip(resampled, f)]) + ordinary

    least = noise([a for a, _ in weights])
    for _ in range(20):
        step = [rng.normal(0, 0.05, len(x)) for x in f]
        assert noise([a + s for (a, _), s in zip(weights, step)]) >= least * (1 - 1e-12)


def test_single_precision(world):
    # differences of sums of some tens of terms
    assert variance(world, np.float32) == pytest.approx(variance(world), rel=2e-4)


def test_drjit_arrays(world, rgb):
    """The same functions on Dr.Jit arrays."""
    lists = [[mi.Float(x) for x in world[key]] for key in ("g", "p", "q_star")]
    result = resampling.estimate_variance(*lists, world["M"], world["N"], dr.sum)
    assert float(result[0]) == pytest.approx(variance(world), rel=2e-4)
    result = resampling.second_moment(*lists, world["M"], world["N"], dr.sum)
    assert float(result[0]) == pytest.approx(moment(world), rel=1e-4)
    for r, p in zip(lists[2], lists[1]):
        probability = resampling.pmf(r / p, dr.sum(r / p), dr.width(p), 0.1)
        assert float(dr.sum(probability)[0]) == pytest.approx(1, abs=1e-6)


# --- limits -------------------------------------------------------------------


@pytest.mark.parametrize("S", [1, 2, 5])
def test_one_sub_path_with_uniform_pmf(S):
    """M = 1 with a pmf uniform over the S lengths: p_t = p/S, bidirectional path tracing with one
    light vertex picked at random."""
    p = np.array([1e-6, 0.3, 2e4])
    ratio = resampling.density_ratio(resampling.pmf(np.ones(3), S, S), 1)
    assert np.allclose(p * resampling.gain(ratio, 1 / S, 1), p / S, rtol=1e-14, atol=0)
    assert np.allclose(resampling.resampled_density(p, p / S, 1 / S, 1), p / S, rtol=1e-14, atol=0)


@pytest.mark.parametrize("uniform", [0, 0.1])
def test_nothing_visible(uniform):
    """Q = 0: the uniform pmf, and weights of finite densities."""
    pmf = resampling.pmf(np.zeros(6), 0.0, 6, uniform)
    assert np.allclose(pmf, 1 / 6, rtol=1e-14)
    assert np.allclose(
        resampling.gain(resampling.density_ratio(pmf, 3), 0.5, 3),
        1 / (1 / 3 + (1 - 0.5 / 3) / 0.5),
        rtol=1e-14,
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_length_share_above_one(dtype):
    """Q_s > M Q by round-off, or by far: the bracket stops at zero and p_t at M p."""
    for share in (1, 1 + np.finfo(dtype).eps, 1.5, 1e6):
        for M in (1, 2):
            value = resampling.gain(np.array([1.0], dtype), np.array([share], dtype), M)
            assert np.all((value > 0) & (value <= M))
    assert np.all(resampling.bracket(np.array([1 + 1e-6, 2, 1e9], dtype), 1) == 0)
    # the only proposal is always drawn
    assert resampling.gain(np.array([0.3], dtype), np.array([1.2], dtype), 1)[0] == 1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_dominant_sub_path(dtype):
    """One sub-path holds nearly all of the target: it is drawn always and has the density M p; the
    others keep the uniform share."""
    r = np.array([1e9, 1, 0, 0], dtype)
    pmf = resampling.pmf(r, r.sum(), 4, 0.04)
    assert pmf.sum() == pytest.approx(1, abs=1e-6) and np.all(pmf >= 0.0099)
    gains = resampling.gain(
        resampling.density_ratio(pmf, 4), np.array([0.97, 0.01, 0.01, 0.01], dtype), 4
    )
    assert np.all(np.isfinite(gains)) and gains[0] > 2 and np.all(gains[1:] < 0.05)
    assert resampling.gain(np.array([np.inf], dtype), np.array([1.0], dtype), 4)[
        0
    ] == pytest.approx(4)


@given(
    ratio=st.one_of(st.just(0.0), st.just(np.inf), st.floats(0, 1e30)),
    share=st.floats(0, 1e6),
    M=st.integers(1, 10000),
    N=st.integers(1, 64),
    dtype=st.sampled_from([np.float32, np.float64]),
)
@settings(max_examples=300, deadline=None)
def test_any_gain_is_a_number(ratio, share, M, N, dtype):
    value = resampling.gain(np.array([ratio], dtype), np.array([share], dtype), M, N)
    assert np.all(np.isfinite(value) & (value >= 0) & (value <= M * (1 + 1e-6))), value
    assert ratio > 0 or value[0] == 0  # what is never drawn has no share


def test_paths_without_techniques():
    weights = resampling.technique_weights([np.array([0.0, 1.0]), np.array([0.0, 3.0])], [1, 2])
    assert np.allclose(weights, [[0, 1 / 7], [0, 6 / 7]], rtol=1e-14)
    assert resampling.proposal_weight(np.array([1.0]), np.array([0.0]))[0] == 0
