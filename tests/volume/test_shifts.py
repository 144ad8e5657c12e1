"""Shifts between segments: against their definitions, against finite differences, and on anything
at all.

With `--vectors DIR` the segments and answers of DIR/shifts.json are used; else segments generated
here, the answers by bisection of the defining equations in double precision.
"""

import json
from pathlib import Path

from mis_integrators.volume import shifts
from mis_integrators.volume.shifts import SHIFTS, Sections

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

STRETCHES = ("raw_depth", "majorant_optical_depth", "primary_sample")
COPIES = tuple(name + "_copy" for name in STRETCHES)


def random_segment(rng, count, scale=1.0):
    """`count` sections with gaps, some of them touching, of majorants over a decade."""
    steps = rng.uniform(0.1, 1.5, 2 * count)
    steps[0::2] *= rng.choice([1, 1, 1e-9], count)
    cuts = np.cumsum(steps)
    return Sections(list(cuts[0::2]), list(cuts[1::2]), list(scale * rng.uniform(0.2, 2.5, count)))


def scale_of(name, segment, t):
    """What the shift `name` conserves, from the definition alone: l, tau or u at t, in double
    precision."""
    inside = [max(0.0, min(t, b) - a) for a, b, _ in segment]
    if name.startswith("raw"):
        return t if name.endswith("copy") else sum(inside)
    tau = sum(mu * x for x, (_, _, mu) in zip(inside, segment))
    return -np.expm1(-tau) if name.startswith("primary") else tau


def by_bisection(name, base, target, t):
    """The shifted distance, from the definition: the t' at which the conserved quantity has the
    wanted value."""
    wanted = scale_of(name, base, t)
    if not name.endswith("copy"):
        wanted *= scale_of(name, target, target.tmax[-1]) / scale_of(name, base, base.tmax[-1])
    low, high = 0.0, target.tmax[-1]
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if scale_of(name, target, middle) < wanted else (low, middle)
    return high


def generated():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        base, target = (random_segment(rng, rng.integers(1, 5)) for _ in range(2))
        k = rng.integers(len(base.tmin))
        t = base.tmin[k] + rng.uniform(0.05, 0.95) * (base.tmax[k] - base.tmin[k])
        answers = {}
        for name in STRETCHES:
            h = 1e-5 * (base.tmax[k] - base.tmin[k])
            moved = [by_bisection(name, base, target, t + d) for d in (0, -h, h)]
            answers[name] = {"t": moved[0], "jacobian": (moved[2] - moved[1]) / (2 * h)}
        yield f"{seed}", base, target, t, answers, 1e-6  # bisection and finite differences


def stored(file):
    # other kinds of vectors are no business of these tests
    entries = json.loads(file.read_text()) if file.exists() else []
    for number, entry in enumerate(entries):
        base, target = (
            Sections(entry[s]["tmin"], entry[s]["tmax"], entry[s]["majorant"])
            for s in ("base", "target")
        )
        yield (
            f"{number}",
            base,
            target,
            entry["t"],
            {name: entry[name] for name in SHIFTS if name in entry},
            1e-10,
        )


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        directory = metafunc.config.getoption("vectors")
        cases = list(generated() if directory is None else stored(Path(directory) / "shifts.json"))
        metafunc.parametrize("case", cases, ids=[case[0] for case in cases])


def on_arrays(segment, make):
    return Sections(
        *(
            [make(np.float64(x)) for x in values]
            for values in (segment.tmin, segment.tmax, segment.majorant)
        )
    )


# --- Known answers ------------------------------------------------------------


def test_stretches(case):
    _, base, target, t, answers, tolerance = case
    for name, answer in answers.items():
        shifted = SHIFTS[name](base, target, np.float64(t))
        assert shifted.valid
        assert shifted.t == pytest.approx(answer["t"], rel=tolerance)
        assert shifted.jacobian == pytest.approx(answer["jacobian"], rel=tolerance)


@pytest.mark.parametrize("precision", [np.float32, "drjit"])
def test_stretches_in_single_precision(case, precision, rgb):
    _, base, target, t, answers, _ = case
    make = (lambda x: mi.Float(float(x))) if precision == "drjit" else np.float32
    for name, answer in answers.items():
        shifted = SHIFTS[name](on_arrays(base, make), on_arrays(target, make), make(t))
        # The primary sample's end turns rounding of tau into errors of exp(tau' - tau): at most
        # e^10 roundings here.
        assert np.allclose(
            np.array(shifted.t), answer["t"], rtol=2e-3 if name == "primary_sample" else 2e-5
        )
        assert np.allclose(
            np.array(shifted.jacobian),
            answer["jacobian"],
            rtol=2e-2 if name == "primary_sample" else 1e-4,
        )


@pytest.mark.parametrize("name", COPIES)
@pytest.mark.parametrize("seed", range(6))
def test_copies(name, seed):
    rng = np.random.default_rng(seed)
    base, target = random_segment(rng, 3), random_segment(rng, 2)
    t = np.concatenate([np.linspace(a, b, 40)[1:-1] for a, b, _ in base if b - a > 1e-3])
    shifted = SHIFTS[name](base, target, t)
    end = target.tmax[-1]
    for at, t_new, valid, jacobian in zip(t, shifted.t, shifted.valid, shifted.jacobian):
        if name == "raw_depth_copy":
            assert valid == any(a <= at <= b for a, b, _ in target)
        else:
            assert valid == (scale_of(name, base, at) <= scale_of(name, target, end))
        if valid:
            assert scale_of(name, target, t_new) == pytest.approx(
                scale_of(name, base, at), rel=1e-9
            )
            rates = [
                next(mu for a, b, mu in segment if a <= x <= b)
                for segment, x in ((base, at), (target, t_new))
            ]
            assert jacobian == pytest.approx(
                1 if name == "raw_depth_copy" else rates[0] / rates[1], rel=1e-9
            )


# --- What every shift obeys ---------------------------------------------------


def interior_points(segment, count, margin=0.02):
    """Points away from the sections' borders."""
    return np.concatenate(
        [
            a + np.linspace(margin, 1 - margin, count) * (b - a)
            for a, b, _ in segment
            if b - a > 1e-3
        ]
    )


def section_of(segment, t):
    return np.argmax([[a <= x <= b for a, b, _ in segment] for x in np.atleast_1d(t)], axis=1)


@pytest.mark.parametrize("name", SHIFTS)
@pytest.mark.parametrize("seed", range(8))
def test_round_trip_chain_rule_and_jacobian(name, seed):
    rng = np.random.default_rng(seed)
    a, b, c = (random_segment(rng, rng.integers(1, 5)) for _ in range(3))
    shift, t = SHIFTS[name], interior_points(a, 9)
    ab, ac = shift(a, b, t), shift(a, c, t)
    back, abc = shift(b, a, ab.t), shift(b, c, ab.t)
    kept = ab.valid
    if name in STRETCHES:
        assert kept.all() and ac.valid.all()
        assert np.all((ab.t >= b.tmin[0]) & (ab.t <= b.tmax[-1]))
        order = np.argsort(t)
        assert np.all(np.diff(ab.t[order]) >= 0)
    assert back.valid[kept].all()
    assert np.allclose(back.t[kept], t[kept], rtol=1e-9)
    assert np.allclose((ab.jacobian * back.jacobian)[kept], 1, rtol=1e-8)
    both = kept & ac.valid
    assert np.all(abc.valid[both])  # so a path has one set of views that can make it
    assert np.allclose(abc.t[both], ac.t[both], rtol=1e-9)
    assert np.allclose((ab.jacobian * abc.jacobian)[both], ac.jacobian[both], rtol=1e-8)

    h = 1e-6
    low, high = shift(a, b, t - h), shift(a, b, t + h)
    same = low.valid & high.valid & (section_of(b, low.t) == section_of(b, high.t))
    slope = (high.t - low.t) / (2 * h)
    smooth = same & (name != "primary_sample" or ab.jacobian < 1e3)
    assert smooth.sum() >= same.sum() / 2
    assert np.allclose(slope[smooth], ab.jacobian[smooth], rtol=1e-4, atol=1e-7)
    # In optical depth, where the sampling density is one.
    tau = (shifts.optical_depth(b, high.t) - shifts.optical_depth(b, low.t)) / (
        shifts.optical_depth(a, t + h) - shifts.optical_depth(a, t - h)
    )
    assert np.allclose(tau[smooth], np.exp(ab.log_rate)[smooth], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("name", STRETCHES)
def test_ends_stay_ends(name):
    rng = np.random.default_rng(3)
    a, b = random_segment(rng, 3), random_segment(rng, 2)
    start, end = (SHIFTS[name](a, b, np.float64(t)) for t in (a.tmin[0] + 1e-12, a.tmax[-1]))
    assert start.t == pytest.approx(b.tmin[0], abs=1e-9) and end.t == pytest.approx(
        b.tmax[-1], abs=1e-6
    )


@pytest.mark.parametrize("name", SHIFTS)
def test_empty_segments(name):
    """Nothing can be placed on a segment without medium, nor taken from one."""
    some, none = Sections([1.0], [2.0], [3.0]), Sections([1.0], [2.0], [0.0])
    for target in (none, Sections([1.5], [1.5], [2.0])):
        shifted = SHIFTS[name](some, target, np.array([1.2, 1.9]))
        assert (
            not shifted.valid.any()
            and np.isfinite(shifted.t).all()
            and np.isfinite(shifted.jacobian).all()
        )
    assert not SHIFTS[name](none, some, np.array([1.5])).valid.any()


@pytest.mark.parametrize("name", SHIFTS)
@pytest.mark.parametrize("precision", [np.float32, np.float64, "drjit"])
def test_thick_media(name, precision, rgb):
    """Optical depths up to 1e4, on either side or on both: finite, in order, inside, and with the
    ends where they belong."""
    make = (lambda x: mi.Float(x)) if precision == "drjit" else (lambda x: np.asarray(x, precision))
    share = np.linspace(0, 1, 201)
    for base_depth in (1e-6, 1e-2, 1, 30, 90, 1e3, 1e4):
        for target_depth in (1e-6, 1e-2, 1, 30, 90, 1e3, 1e4):
            base = Sections(
                [make(0.0), make(2.0)],
                [make(1.0), make(3.0)],
                [make(base_depth * 0.25), make(base_depth * 0.75)],
            )
            target = Sections([make(1.0)], [make(5.0)], [make(target_depth / 4)])
            t = np.concatenate([share[1:], 2 + share])
            shifted = SHIFTS[name](base, target, make(t))
            values = [
                np.array(x) for x in (shifted.t, shifted.tau, shifted.log_rate, shifted.jacobian)
            ]
            assert all(np.isfinite(v[np.array(shifted.valid)]).all() for v in values)
            if name in STRETCHES:
                assert np.array(shifted.valid).all()
                assert (
                    np.all(np.diff(values[0]) >= -1e-5)
                    and values[0].min() >= 1
                    and values[0].max() <= 5
                )
                assert values[0][-1] == pytest.approx(5, abs=1e-5)
                assert np.all(values[3] >= 0)
                # all of the base's first hundredth goes to the end only if it is opaque
                assert values[0][0] < 4.999 or base_depth > 100


def test_primary_sample_deep_inside():
    """Where the printed form C / (C - (C - 1) exp(tau)) is 0 times infinity: equal depths are the
    identity, and beyond the visible depth of the thinner segment the far end is stretched by
    exp(tau) as it should."""
    for depth in (80.0, 500.0, 1e4):
        segment = Sections([np.float32(0)], [np.float32(1)], [np.float32(depth)])
        t = np.linspace(0.01, 0.99, 50, dtype=np.float32)
        same = shifts.primary_sample(segment, segment, t)
        assert np.allclose(same.t, t, atol=1e-6) and np.allclose(same.jacobian, 1, rtol=1e-3)
    thin, thick = Sections([0.0], [1.0], [2.0]), Sections([0.0], [1.0], [200.0])
    t = np.array([0.3, 0.999])
    # u'max = 1 in double precision
    expected = [-np.log1p(-np.expm1(-2 * x) / np.expm1(-2.0)) / 200 for x in t]
    assert np.allclose(shifts.primary_sample(thin, thick, t).t, expected, rtol=1e-9)


segments = st.lists(
    st.tuples(
        st.one_of(st.just(0.0), st.floats(1e-3, 10)),
        st.one_of(st.just(0.0), st.floats(1e-3, 10)),
        st.one_of(st.just(0.0), st.floats(1e-4, 1e4)),
    ),
    min_size=1,
    max_size=5,
)


@given(
    segments,
    segments,
    st.floats(0, 1),
    st.sampled_from(list(SHIFTS)),
    st.sampled_from([np.float32, np.float64]),
)
@settings(max_examples=400, deadline=None)
def test_anything(base, target, share, name, precision):
    """Empty sections, pockets, single points: numbers are finite, valid results lie in a medium,
    and stretches lose nothing that is in one."""

    def segment(pieces):
        cuts = np.cumsum([x for gap, size, _ in pieces for x in (gap, size)]).astype(precision)
        return Sections(list(cuts[0::2]), list(cuts[1::2]), [precision(mu) for _, _, mu in pieces])

    base, target = segment(base), segment(target)
    t = precision(share * base.tmax[-1])
    shifted = SHIFTS[name](base, target, t)
    assert all(np.isfinite(x) for x in (shifted.t, shifted.tau, shifted.log_rate, shifted.jacobian))
    in_medium = shifts.majorant_at(base, t) > 0
    if shifted.valid:
        assert in_medium and shifts.majorant_at(target, shifted.t) > 0 and shifted.jacobian >= 0
    elif name in STRETCHES:
        assert not in_medium or shifts.total_length(target) == 0


@given(st.floats(0, 1e4))
def test_elementary_functions(x):
    mi.set_variant("llvm_ad_rgb")
    assert float(shifts.one_minus_exp(mi.Float(x))[0]) == pytest.approx(
        -np.expm1(-x), rel=2e-6, abs=1e-37
    )
    u = min(x / 2e4, 0.5)
    assert float(shifts.minus_log_one_minus(mi.Float(u))[0]) == pytest.approx(
        -np.log1p(-u), rel=2e-6, abs=1e-37
    )
