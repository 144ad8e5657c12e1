"""Weights of strategies that make the same paths: on discrete worlds, where the best ones are
known, and on anything at all.

With `--vectors DIR` the worlds and answers of DIR/optimal_weights.json are used; else worlds
generated here, their answers by brute force. (Those of DIR/resampling.json: `test_resampling`,
whose tests of worlds run here too.)
"""

import dataclasses
import functools
import json
from pathlib import Path

from mis_integrators.weights import heuristics, mis2, mis3, recursion

import discrete_worlds as worlds
import mitsuba as mi
import numpy as np
import pytest
import test_resampling
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from test_resampling import (  # noqa: F401
    test_any_pmf_is_unbiased,
    test_densities_are_those_of_the_variance,
    test_variance_is_exact,
)

GENERATED = [(K, seed) for K in (2, 3, 4, 5) for seed in range(6)]


@functools.cache
def generated(K, seed, **options):
    """A world, its best weights and their noise by brute force, and no noise of single strategies
    (the vectors have it)."""
    world = worlds.random_world(seed, K, **options)
    weights = worlds.brute_force(world)
    return world, weights, worlds.noise(world, weights), None


def pytest_generate_tests(metafunc):
    """The worlds, of as many strategies as the mark `strategies` says (without it: any)."""
    test_resampling.pytest_generate_tests(metafunc)
    if "case" not in metafunc.fixturenames:
        return
    mark = metafunc.definition.get_closest_marker("strategies")
    directory = metafunc.config.getoption("vectors")
    if directory is None:
        cases = [
            (K, f"K{K}-{seed}", functools.partial(generated, K, seed)) for K, seed in GENERATED
        ]
    else:
        file = Path(directory) / "optimal_weights.json"
        # other kinds of vectors are no business of these tests
        entries = json.loads(file.read_text()) if file.exists() else []
        cases = [
            (entry["K"], f"K{entry['K']}-{i}", functools.partial(worlds.load, entry))
            for i, entry in enumerate(entries)
        ]
    cases = [(name, make) for K, name, make in cases if mark is None or K in mark.args]
    metafunc.parametrize(
        "case", [make for _, make in cases], ids=[name for name, _ in cases], indirect=True
    )


@pytest.fixture
def case(request):
    return request.param()


def distance(weights, expected, relative=True, world=None):
    """Largest difference, relative to 1 + |w|, where light makes the weight matter."""
    return max(
        np.max(
            np.abs(weights[family, i] - w)
            / (1 + np.abs(w) * relative)
            * (world is None or world.light(family) > 0)
        )
        for (family, i), w in expected.items()
    )


def closed_form(world):
    """The papers' weights, for two and three strategies."""
    f, measure, n = world.f, world.measure, world.n_F

    def integrate(j):
        return lambda x: np.sum(x * measure[j], axis=-1)

    if world.K == 2:
        values = mis2.weights(f[0], world.p(0), world.L, world.b, n, integrate(0), world.N_B)
    else:
        E1, mu1 = world.albedo(0), world.albedo(1)
        values = mis3.weights(
            f[0],
            f[1],
            world.L0[0],
            world.L,
            world.b,
            E1,
            E1 * mu1,
            n,
            integrate(0),
            integrate(1),
            world.N_B,
        )
    return dict(zip(world.families(), values))


# --- optimal weights of known worlds ------------------------------------------


def test_recursion(case):
    world, expected, J, _ = case
    weights, e = worlds.recurse(world)
    # the answers' own rounding is 1e-11; weights are of order 10
    assert distance(weights, expected, relative=False) < 1e-9
    # quadratic in the weights' error: rounding only
    assert worlds.noise(world, weights) == pytest.approx(J, rel=1e-9)
    assert all(np.all((x > 0) & (x <= 1)) for x in e)


@pytest.mark.parametrize("K, seed", [(K, seed) for K in (2, 3, 4, 5) for seed in range(3)])
def test_recursion_with_mixed_kernels(K, seed):
    """Merging costs differ from vertex to vertex, as between disks and balls: with BSDFs and
    densities in units of the cost, the recursion finds the best weights of brute force."""
    world, expected, J, _ = generated(K, seed, mixed=True)
    weights, _ = worlds.recurse(world)
    assert distance(weights, expected) < 1e-9
    assert worlds.noise(world, weights) == pytest.approx(J, rel=1e-9)
    even, _ = worlds.recurse(dataclasses.replace(world, cost=None))
    assert worlds.noise(world, even) > 1.001 * J


def test_recursion_in_single_precision(case):
    world, expected, _, _ = case
    weights, _ = worlds.recurse(world, dtype=np.float32)
    assert all(w.dtype == np.float32 for w in weights.values())
    # some hundred roundings of 6e-8, no cancellation but in 1 - sum: 4e-7 seen
    assert distance(weights, expected) < 1e-4


def test_single_strategies(case):
    world, _, J, singles = case
    for k in range(world.K):
        noise = worlds.noise(world, worlds.single(world, k))
        # sums of a hundred positive terms
        assert singles is None or noise == pytest.approx(singles[k], rel=1e-9)
        assert noise >= J


@pytest.mark.strategies(2, 3)
def test_closed_forms(case):
    world, expected, _, _ = case
    # What cancels in 1 - n (...) is of order n times rounding: 4e-16 n seen up to n = 1e10. The
    # vectors stay below n = 1e3.
    assert distance(closed_form(world), expected) < 1e-9 + 1e-14 * world.n_F


def test_two_strategies_deeper():
    """MIS-2 with M > 0: the first merging vertex is not shared by the N_B camera paths."""
    world = dataclasses.replace(worlds.random_world(2, 2), N_B=4)
    f, p, measure = world.f[0], world.p(0), world.measure[0]
    deeper = mis2.weights(
        f, p, world.L, world.b, world.n_F, lambda x: np.sum(x * measure), world.N_B, M=1
    )
    expected, _ = worlds.recurse(dataclasses.replace(world, N_B=1))
    assert distance({(2, 0): deeper[0], (2, 1): deeper[1]}, expected) < 1e-9


@pytest.mark.strategies(3)
def test_noise_is_the_papers(case):
    """MIS-3's J as printed, written out, against `residuals`."""
    world, weights, J, _ = case
    (f0, f1), (dmu1, dmu2), (L0,), L, n = world.f, world.measure, world.L0, world.L, world.n_F
    w20, w21, w30, w31, w32 = (weights[key] for key in world.families())
    E1 = world.albedo(0)
    E2 = E1 * world.albedo(1)[:, None]
    rho = L * (f0 * dmu1)[:, None] * f1 * dmu2
    G1, G2 = (np.sum(w * L * f1 * dmu2, axis=-1) for w in (w31, w32))
    c = w21 * L0 + G1
    F = np.sum((c + G2) * f0 * dmu1)
    printed = (
        world.N_B / n * (np.sum(w20**2 * f0**2 * L0 * dmu1) + np.sum(w30**2 * f0[:, None] * rho))
        + (np.sum(w31**2 * E1 * f1 * rho) + np.sum(w32**2 * E2 * world.c() * rho)) / n
        - F**2
        + E1 * np.sum((c**2 + 2 * c * G2) * f0 * dmu1)
        + np.sum(w32**2 * E2 * L * rho)
    )
    assert J == pytest.approx(printed, rel=1e-9)  # -F^2 + ... cancels: a few digits of sixteen


@pytest.mark.strategies(3, 4, 5)
def test_least_noise_without_weights(case):
    """J_opt from the root's responses alone."""
    world, _, J, _ = case
    weights, e = worlds.recurse(world)
    luminance = world.L
    for j in range(world.K - 2, 0, -1):
        luminance = world.L0[j - 1] + np.sum(world.f[j] * world.measure[j] * luminance, axis=-1)
    kappa = world.N_B * world.f[0]
    d = kappa * weights[2, 1] / e[0]
    terms = (
        kappa
        * world.f[0]
        * world.measure[0]
        * (luminance - (1 - e[0]) * d / (world.n_F * world.albedo(0)))
    )
    assert np.sum(terms) / world.n_F == pytest.approx(J, rel=1e-9)


@pytest.mark.parametrize("size", [1e-3, 1])
def test_no_change_lowers_noise(case, size):
    world = case[0]
    weights, _ = worlds.recurse(world)
    least, rng = worlds.noise(world, weights), np.random.default_rng(0)
    for _ in range(20):
        change = size * rng.standard_normal(worlds.free(world))
        for sign in (
            1,
            -1,
        ):  # one of both lowers it wherever there is a slope; rounding of J is 1e-15
            assert worlds.noise(world, worlds.perturbed(world, weights, sign * change)) > least * (
                1 - 1e-12
            )


@pytest.mark.strategies(2, 3)
def test_local_weights_are_the_papers(case):
    world = case[0]
    weights, _ = worlds.recurse(world, local=True)
    f, n = world.f, world.n_F
    if world.K == 2:
        g = mis2.shared_density(world.p(0), world.N_B)
        expected = {(2, 1): mis2.local_weight(g, n, mis2.denominator(g, n, world.b, world.L))}
    else:
        E1, q = world.albedo(0), mis3.first_cost(f[0], world.N_B)
        W20, W21, _ = mis3.local_direct(q, n, E1, world.L0[0])
        E2, c = E1 * world.albedo(1)[:, None], mis3.deepest_cost(world.b, world.L, n)
        w31, w32 = mis3.local_longest(W21[:, None], q[:, None], E1, f[1], E2, c)
        expected = {(2, 0): W20, (2, 1): W21, (3, 0): 1 - w31 - w32, (3, 1): w31, (3, 2): w32}
    assert distance(weights, expected) < 1e-13  # a dozen roundings of positive terms
    assert all(np.all((w > -1e-13) & (w < 1 + 1e-13)) for w in weights.values())


@pytest.mark.parametrize("local", [False, True])
def test_drjit_arrays(case, local, rgb):
    world = case[0]
    expected, _ = worlds.recurse(world, local, np.float32)
    weights, _ = worlds.recurse(world, local, np.float32, worlds.on_drjit)
    assert distance(weights, expected) < 1e-5  # fused multiply-adds round otherwise


# --- extreme worlds -----------------------------------------------------------


@pytest.mark.parametrize("K", [2, 3, 4, 5])
@pytest.mark.parametrize("n", [0.01, 1, 1e4, 1e10])
# 4: values from 1e-7 to 1e7
@pytest.mark.parametrize("spread, zeros", [(1.2, 0), (1.2, 0.4), (4, 0.2)])
def test_extreme_worlds(K, n, spread, zeros):
    world, best, J, _ = generated(K, 11, states=(2,) * (K - 1), n_F=n, spread=spread, zeros=zeros)
    weights, _ = worlds.recurse(world)
    noise = worlds.noise(world, weights)
    # Nothing better exists, and brute force comes as near as its conditioning lets it.
    assert noise <= J * (1 + 1e-9)
    if spread < 2:
        assert noise == pytest.approx(J, rel=1e-9)
        # lstsq's rounding times condition: 2e-8 at n = 1e10
        assert distance(weights, best, world=world) < 1e-6
        single, _ = worlds.recurse(world, dtype=np.float32)
        assert distance(single, weights) < 1e-4
        assert worlds.noise(
            world, {key: w.astype(np.float64) for key, w in single.items()}
        ) < noise * (1 + 1e-6 + 1e-11 * n)


def test_small_scattering_in_single_precision():
    """A BSDF value far below r (theta rounds to one): the shares f/(r + f) must not be lost."""
    for seed in range(20):
        world = worlds.random_world(seed, 4, spread=6, n_F=100.0)
        noise = [
            worlds.noise(
                world,
                {key: w.astype(np.float64) for key, w in worlds.recurse(world, dtype=t)[0].items()},
            )
            for t in (np.float32, np.float64)
        ]
        assert noise[0] == pytest.approx(noise[1], rel=1e-4)  # quadratic in weights' errors


@pytest.mark.parametrize("K", [2, 3, 4, 5])
def test_few_photons(K):
    """Kernels cost all, the camera's variance nothing: weights inverse to kernel costs, all to
    direct light at the deepest vertex."""
    world = worlds.random_world(3, K, n_F=1e-9)
    weights, _ = worlds.recurse(world)
    throughput, kappa = np.array(1.0), []
    for i in range(K):
        cost = (
            throughput * world.c()
            if i == K - 1
            else throughput[..., None] * world.f[i] * (world.N_B if i == 0 else 1)
        )
        kappa.append(cost.reshape(cost.shape + (1,) * (K - 1 - cost.ndim)))
        if i < K - 1:
            throughput = (throughput * world.albedo(i))[..., None] * np.ones_like(world.f[i])
    total = sum(1 / k for k in kappa)
    # first order in n
    assert all(np.allclose(weights[K, i], 1 / k / total, atol=1e-6) for i, k in enumerate(kappa))
    assert all(np.allclose(weights[family, family - 1], 1, atol=1e-6) for family in range(2, K))


# --- any input ----------------------------------------------------------------

values = st.one_of(st.just(0.0), st.floats(1e-12, 1e6))
factors = st.one_of(st.just(0.0), st.floats(1e-3, 1e3))


@st.composite
def any_worlds(draw):
    """Non-negative numbers, zeros included, with no relation to each other."""
    K = draw(st.integers(2, 5))
    states = [draw(st.integers(1, 2)) for _ in range(K - 1)]
    shapes = [tuple(states[: j + 1]) for j in range(K - 1)]

    def numbers(shape):
        return draw(arrays(np.float64, shape, elements=values))

    measure = [draw(arrays(np.float64, shape, elements=st.floats(1e-3, 3))) for shape in shapes]
    f = [np.minimum(numbers(shape), 1e3) for shape in shapes]
    return worlds.World(
        K,
        draw(st.integers(1, 64)),
        draw(st.one_of(st.just(0.0), st.floats(1e-2, 1e10))),
        measure,
        f,
        [numbers(shape) for shape in shapes[:-1]],
        numbers(shapes[-1]),
        numbers(shapes[-1]),
    )


@given(any_worlds(), st.lists(factors, min_size=40, max_size=40), st.booleans())
@settings(max_examples=200, deadline=None)
def test_anything_gives_weights(world, noise, local):
    """Also with integrals that are wrong by any factor: the recursion has no singular place."""
    for dtype in (np.float32, np.float64):
        factor = iter(noise)

        def off(x, factor=factor, dtype=dtype):
            return (x * next(factor)).astype(dtype)

        with np.errstate(over="ignore", under="ignore"):
            weights, e = worlds.recurse(world, local, dtype, estimate=off)
        assert all(np.all((x > 0) & (x <= 1)) for x in e)
        assert all(np.all(np.isfinite(w)) for w in weights.values())
        for count in range(2, world.K + 1):
            family = [weights[count, i].astype(np.float64) for i in range(count)]
            size = 1 + sum(np.abs(w) for w in family)
            # at most five terms
            assert np.all(np.abs(sum(family) - 1) < 10 * np.finfo(dtype).eps * size)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_weight_for_what_cannot_be(dtype):
    """Directions that the camera path never takes though the BSDF scatters there: all weight to the
    strategies before."""

    class Blocked(worlds.World):
        def p(self, j):
            density = super().p(j)
            density[..., 0] = 0
            return density

    for K in (2, 3, 4):
        world = Blocked(**vars(worlds.random_world(5, K)))
        # nor does a luminance that the weights take for zero change that
        world.L0 = [0 * x for x in world.L0]
        weights, _ = worlds.recurse(world, dtype=dtype)
        for family, i in world.families():
            for j in range(i):  # z_{j+1} unreachable
                assert np.all(weights[family, i][(slice(None),) * j + (0,)] == 0)


def test_responses():
    gamma = np.float32([0, 1e-12, 0.5, 1e9, 1e30, np.inf])
    e, eta = recursion.remainder(gamma), recursion.response(gamma)
    assert np.all(np.isfinite(e) & (e > 0) & (eta >= 0) & (eta <= 1))
    assert eta[1] == np.float32(1e-12) and np.allclose(e + eta, 1, atol=1e-7)
    r, f = np.float32([0, 1, 1, 0]), np.float32([1, 0, 1e-12, 0])
    assert np.allclose(recursion.kernel_share(r, f), [0, 1, 1, 0], atol=0)
    assert np.allclose(recursion.kernel_rest(r, f), [1, 0, 1e-12, 0], rtol=1e-6, atol=0)


# --- heuristics ---------------------------------------------------------------


@given(st.lists(st.floats(-13, 13), min_size=1, max_size=6), st.sampled_from([1, 2, 3, 1.5]))
@settings(max_examples=200, deadline=None)
def test_heuristics_are_veachs(logarithms, beta):
    # ratios^beta up to e^26, within the limit of 1e12
    densities = np.exp(np.array(logarithms) / beta)
    expected = densities**beta / np.sum(densities**beta)
    ratios = list(densities[:-1] / densities[1:])
    # Positive terms only: a hundred roundings of 1e-16 at most.
    assert np.allclose(heuristics.heuristic_weights(ratios, beta), expected, rtol=1e-12, atol=0)
    for k, w in enumerate(expected):
        before = after = 0.0
        for ratio in ratios[:k]:
            before = heuristics.add_ratio(before, ratio, beta)
        for ratio in reversed(ratios[k:]):
            after = heuristics.add_ratio(after, 1 / ratio, beta)
        assert heuristics.weight(before, after) == pytest.approx(w, rel=1e-12)


@given(
    st.lists(st.one_of(st.sampled_from([0.0, np.inf]), st.floats(1e-30, 1e30)), max_size=5),
    st.sampled_from([1, 2]),
    st.sampled_from([np.float32, np.float64]),
)
@settings(max_examples=200, deadline=None)
def test_heuristics_take_any_ratio(ratios, beta, dtype):
    with np.errstate(over="ignore"):
        weights = heuristics.heuristic_weights([np.array([ratio], dtype) for ratio in ratios], beta)
    assert all(np.all((w >= 0) & (w <= 1)) for w in weights)
    # six roundings, and the limit's 1e-12
    assert np.sum(weights) == pytest.approx(1, abs=float(20 * np.finfo(dtype).eps + 1e-11))


def test_heuristics_of_impossible_strategies():
    assert np.allclose(heuristics.heuristic_weights([np.inf]), [1, 0], atol=1e-11)
    assert np.allclose(heuristics.heuristic_weights([0.0]), [0, 1], atol=1e-11)
    assert np.allclose(heuristics.heuristic_weights([np.inf, 0.0]), [0.5, 0, 0.5], atol=1e-11)


def test_heuristics_on_drjit(rgb):
    ratios = np.float32(10) ** np.random.default_rng(0).uniform(-5, 5, (5, 100)).astype(np.float32)
    ratios[:, :2] = 0, np.inf
    for beta in (1, 2, 1.5):
        weights = heuristics.heuristic_weights([mi.Float(r) for r in ratios], beta)
        with np.errstate(over="ignore"):
            expected = heuristics.heuristic_weights(list(ratios), beta)
        # powers of Dr.Jit: a few roundings, times ten factors
        assert np.allclose(np.array(weights), expected, rtol=1e-4, atol=1e-7)


def test_closed_forms_on_drjit(rgb):
    """The elementwise formulas, chained without quadrature."""
    import drjit as dr

    x = np.random.default_rng(1).uniform(0.5, 2, (11, 50)).astype(np.float32)

    def chain(f, p, L, b, W, E1, E2, D, F, G1, G2):
        alpha = mis2.denominator(p, 3.0, b, L)
        A = mis3.matrix_A(p, E1, f, E2, mis3.deepest_cost(b, L, 3.0))
        return (
            mis2.deeper_weight(mis2.local_weight(p, 3.0, alpha), p, f, alpha, 0.3, 0.2),
            mis3.direct_weight(W, 3.0, E1, G1, G2, F, D),
            *mis3.solve_h(*mis3.matrix_B(0.01, E1, W, 1 - W, *A[:3]), *A[:3]),
            *mis3.longest_weights(*A, p, 3.0, E1, W, 1 - W, F, G1, G2),
            *mis3.local_longest(W, p, E1, f, E2, b),
        )

    for result, expected in zip(chain(*[mi.Float(a) for a in x]), chain(*x.astype(np.float64))):
        assert dr.width(result) == 50
        # a dozen roundings, mild cancellation
        assert np.all(np.abs(np.array(result) - expected) < 1e-4 * (1 + np.abs(expected)))
