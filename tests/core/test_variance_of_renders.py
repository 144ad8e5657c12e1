"""The variance channels of renders whose iterations share low-discrepancy sequences, against what
other seeds make of the same picture."""

from pathlib import Path

import mis_integrators  # noqa: F401  before mitsuba: it chooses the LLVM

import mitsuba as mi
import numpy as np
import pytest
from selection import extended

SCENES = Path(__file__).parents[2] / "scenes"
SEEDS = 24


def load(name, size, rfilter="box"):
    """A bundled scene with a film of `size` and a reconstruction filter."""
    text = (SCENES / f"{name}.xml").read_text()
    text = text.replace('<rfilter type="box"/>', f'<rfilter type="{rfilter}"/>')
    assert f'"{rfilter}"' in text
    scene = mi.load_string(text)
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("film.size"))
    parameters[key] = list(size)
    parameters.update()
    return scene


def session(scene, radius, seed, **parameters):
    plugin = mi.load_dict(
        {
            "type": "bdpm",
            "bdd": 0,
            "initial_radius": radius,
            "direct_paths": 1,
            "hide_emitters": True,  # see `test_variance_channels_tell_the_variance`
            **parameters,
        }
    )
    made = plugin.session(scene, 0, seed=seed)
    made.keep_variance()
    return made


def taken_for_independent(made):
    """The variance of each pixel's mean that the squares of iterations alone tell."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(made.accumulator, "stratified", False)
        return made.estimate()[1]


def blocks(image):
    """Means over 8 x 8 pixels and the channels."""
    height, width, channels = image.shape
    return image.reshape(height // 8, 8, width // 8, 8, channels).mean(axis=(1, 3, 4))


@pytest.mark.long
@pytest.mark.parametrize(
    "name, width, height, radius, rfilter, counts",
    [
        ("cornell_area", 32, 32, 0.17, "gaussian", (16,)),
        *extended(
            ("cornell_area", 32, 32, 0.17, "box", (16, 64)),
            ("caustics", 32, 24, 0.2, "box", (16,)),
        ),
    ],
)
def test_variance_channels_tell_the_variance(rgb, name, width, height, radius, rfilter, counts):
    """Mean over 24 seeds, whole and by blocks of 8 x 8 pixels, against the variance among the seeds
    (of each pixel: relative error sqrt(2 / 23) = 29 %). The ratio of the whole image has a standard
    deviation of 2.5 to 4.5 % (jackknife over the seeds). It was 0.95 to 1.04, and 1.13 for the
    caustics; so 25 % are four to eight standard deviations away for the former (false alarms below
    1e-4 a case) and 2.7 for the latter (4e-3). A block's has about 10 %: a factor 2 is beyond
    chance. What took iterations for independent would find 1.4 to 1.7 for the whole image, and be
    off by more than two in an eighth of the blocks of the second case.

    Lamps are hidden: the edge of a bright, axis-aligned shape falls on the same place of all pixels
    in a row, and the variance after 2 n iterations cannot be told from n: the area of a pixel that
    it covers, times n, may be next to a whole number or not."""
    scene = load(name, (width, height), rfilter)
    means, variances, naive = ({n: [] for n in counts} for _ in range(3))
    for seed in range(SEEDS):
        made = session(scene, radius, seed)
        for n in counts:
            while made.iterations < n:
                made.iterate()
            mean, variance = made.estimate()
            assert np.isfinite(variance).all() and (variance >= 0).all()
            means[n].append(mean)
            variances[n].append(variance)
            naive[n].append(taken_for_independent(made))
    for n in counts:
        estimated, true = np.mean(variances[n], axis=0), np.var(means[n], axis=0, ddof=1)
        assert estimated.mean() == pytest.approx(true.mean(), rel=0.25), n
        ratio = blocks(estimated) / blocks(true)
        assert np.mean((ratio > 0.5) & (ratio < 2)) >= 0.95, (n, ratio)
        assert np.mean(naive[n]) > 1.3 * true.mean(), "test too weak"


def test_variance_of_independent_iterations_is_that_of_their_squares(rgb):
    """As it always was; nothing more is summed."""
    scene = load("cornell_area", (8, 8))
    made = session(scene, 0.17, 0, sampler="independent")
    images = []
    for _ in range(6):
        before = np.array(made.sums["total"]) if made.iterations else 0
        made.iterate()
        images.append((np.array(made.sums["total"]) - before)[..., :3])
    expected = np.var(images, axis=0, ddof=1) / 6  # the box filter's weights are all one
    np.testing.assert_allclose(made.estimate()[1], expected, rtol=1e-9, atol=1e-12)
    assert made.sums.tensors.keys() == {"total", "left_out", "square", "cross", "weight_square"}
    assert np.array_equal(made.estimate()[1], taken_for_independent(made))


def test_two_iterations_are_no_more_than_their_difference(rgb):
    made = session(load("cornell_area", (8, 8)), 0.17, 0)
    made.iterate()
    made.iterate()
    grey = made.estimate()[1].mean()
    assert grey == pytest.approx(taken_for_independent(made).mean(), rel=1e-9)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_variance_is_the_same_wherever_iterations_were_made(rgb, rfilter):
    """19 iterations in one session; the same by three, in another order, gathered by a fourth; and
    two thirds of them, with gaps."""
    scene = load("cornell_area", (16, 12), rfilter)
    whole, gathered, part = (session(scene, 0.17, 5) for _ in range(3))
    for _ in range(19):
        whole.iterate()
    for first in (2, 0, 1):
        worker = session(scene, 0.17, 5)
        for iteration in reversed(range(first, 19, 3)):
            worker.iterate(iteration)
        sums, done = worker.sums.take()
        gathered.sums.merge(sums, done)
        if first:
            part.sums.merge(sums, done)
    assert {name: array.shape for name, array in gathered.sums.arrays().items()} == {
        name: tuple(shape) for name, shape in whole.sum_shapes().items()
    }
    for one, other in zip(whole.estimate(), gathered.estimate()):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-7 * one.max())
    variance = part.estimate()[1]
    assert np.isfinite(variance).all() and (variance >= 0).all()
    assert 0.5 < variance.mean() / taken_for_independent(part).mean() < 1.5
