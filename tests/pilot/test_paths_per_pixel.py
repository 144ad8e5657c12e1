"""How many paths each pixel sends for direct light: the law, and the minimum."""

from mis_integrators.pilot import direct_paths
from mis_integrators.pilot.noise import relative_weights

import numpy as np
import pytest

WIDTH = 24


def samples_of(lamp=50.0, seed=0):
    """A noisy left half, a quiet right half, and a lamp whose lower edge crosses the pixels of one
    row."""
    rng = np.random.default_rng(seed)
    image = np.full((direct_paths.TRIALS, 16, WIDTH), 0.2)
    image[:, :, : WIDTH // 2] *= rng.exponential(size=(direct_paths.TRIALS, 16, WIDTH // 2))
    image[:, :4, 4:20] = lamp
    image[:, 4, 4:20] = lamp * (rng.random((direct_paths.TRIALS, 16)) < 0.5)
    return image.reshape(direct_paths.TRIALS, -1)


def found_in(samples):
    return direct_paths.measure(samples, WIDTH)


def objective(paths, samples, light, error, iterations, exponent):
    """What the module says that it minimises, of paths of one block."""
    mean, noise = direct_paths.measure(samples, WIDTH)[:2]
    relative = relative_weights(mean + light)
    left = noise * iterations ** (1 - exponent) * paths**-exponent
    return (
        np.log(error + np.mean(relative * left))
        + np.log(error / np.median(relative) + np.mean(left))
        + 2 * np.log(1 + direct_paths.COST * np.mean(paths - 1))
    )


@pytest.mark.parametrize("iterations, exponent", [(1, 1.0), (64, 1.0), (64, 1.5)])
def test_no_other_numbers_do_better(iterations, exponent):
    """In random directions, within the bounds."""
    samples, rng = samples_of(), np.random.default_rng(1)
    found = found_in(samples)
    given = found, 0.1, 0.05, iterations, exponent
    best = direct_paths.paths_per_pixel(*given)
    assert best.min() >= 1 and best.max() > 3
    least = objective(best, samples, 0.1, 0.05, iterations, exponent)
    for step in (0.03, 0.3):
        for _ in range(50):
            other = best * np.exp(step * rng.normal(size=best.shape))
            other = np.clip(other, 1, direct_paths.MOST_PATHS)
            assert objective(other, samples, 0.1, 0.05, iterations, exponent) > least - 1e-9


def test_paths_go_where_the_noise_is():
    paths = direct_paths.paths_per_pixel(found_in(samples_of()), 0.1, 0.05, 32, 1.5)
    paths = paths.reshape(16, WIDTH)
    assert paths[4, 6:18].min() > 4 * np.median(paths[8:, : WIDTH // 2])
    far = 5 + direct_paths.AROUND // 2  # rows without noise near
    assert np.all(paths[far + 1 :, WIDTH // 2 + 6 :] == 1)
    assert np.all(paths[:2, 6:18] < paths[4, 6:18].min() / 2)


def test_an_edge_between_pixels_counts():
    """No sample of these pixels differs from the others, but the neighbours do."""
    image = np.zeros((direct_paths.TRIALS, 24, WIDTH))
    image[:, :12] = 30.0
    paths = direct_paths.paths_per_pixel(
        found_in(image.reshape(direct_paths.TRIALS, -1)), 0.1, 0.05, 32, 1.5
    ).reshape(24, WIDTH)
    assert np.all(paths[11:13] > 2)
    reach = direct_paths.AROUND // 2  # of rows that are counted a little
    assert np.all(paths[: 11 - reach] == 1) and np.all(paths[13 + reach :] == 1)
    assert np.all(paths[[9, 10, 13, 14]] < paths[11:13].min() / 2)


def test_rare_bright_paths_that_trials_miss_have_more():
    """A path of 300 is bright in a corner of the film: of most of its pixels one half of the
    trials, and their neighbours', has met none."""
    rng, size = np.random.default_rng(5), 24
    image = np.full((direct_paths.TRIALS, size, size), 0.2)
    image[:, :12, :12] = np.where(rng.random((direct_paths.TRIALS, 12, 12)) < 1 / 300, 60.0, 0.2)
    samples = image.reshape(direct_paths.TRIALS, -1)
    halves = (direct_paths.smoothed(half.max(axis=0), size) for half in np.array_split(samples, 2))
    unseen = np.minimum(*halves).reshape(size, size)[2:10, 2:10] < 0.21
    assert unseen.mean() > 0.8
    found = direct_paths.measure(samples, size)
    paths = direct_paths.paths_per_pixel(found, 0.1, 0.05, 32, 1.5).reshape(size, size)
    assert np.median(paths[2:10, 2:10]) > 1.5 and np.all(paths[17:, 17:] == 1)


def test_large_films_have_trials_in_some_pixels():
    for width, height in ((256, 256), (512, 512)):
        rows, columns, nearest = direct_paths.coarser(width, height)
        assert (len(rows), len(columns)) == (height, width)
        np.testing.assert_array_equal(nearest, np.arange(width * height))
    width, height = 1921, 1083
    rows, columns, nearest = direct_paths.coarser(width, height)
    assert len(rows) * len(columns) <= 1.01 * direct_paths.MOST_TRIED
    row, column = np.divmod(np.arange(width * height), width)
    assert np.abs(rows[nearest // len(columns)] - row).max() <= 2
    assert np.abs(columns[nearest % len(columns)] - column).max() <= 2


def test_quiet_pixels_send_one_path():
    quiet = np.full((direct_paths.TRIALS, 8 * WIDTH), 0.3)
    assert np.all(direct_paths.paths_per_pixel(found_in(quiet), 0.0, 0.1, 16, 1.5) == 1)
    assert np.all(direct_paths.paths_per_pixel(found_in(0 * quiet), 0.0, 0.0, 16, 1.5) == 1)


def test_broken_samples_break_nothing():
    samples = samples_of()
    samples[1, 7], samples[2, 300] = np.nan, np.inf
    paths = direct_paths.paths_per_pixel(found_in(samples), 0.1, 0.05, 16, 1.5)
    assert np.all(np.isfinite(paths)) and paths.max() > 3


def test_an_iteration_takes_no_longer_than_there_is_time():
    """Paths go where they went, in proportion, and the dearer a path, the fewer."""
    given = found_in(samples_of()), 0.1, 0.05, 4, 1.5
    free, bound, none = (
        direct_paths.paths_per_pixel(*given, cost=0.2, most_cost=most) for most in (np.inf, 1.3, 1)
    )
    assert direct_paths.cost_of_all(0.2, free) > 1.5
    assert direct_paths.cost_of_all(0.2, bound) == pytest.approx(1.3)
    np.testing.assert_allclose((bound - 1) / np.mean(bound - 1), (free - 1) / np.mean(free - 1))
    assert np.all(none == 1)
    assert direct_paths.paths_per_pixel(*given, cost=0.4).mean() < 0.9 * free.mean()


def test_noisy_photons_need_fewer_paths():
    few, many = (
        direct_paths.paths_per_pixel(found_in(samples_of()), 0.1, error, 16, 1.0).mean()
        for error in (1.0, 0.01)
    )
    assert few < 0.7 * many


def test_error_that_is_left_falls_with_the_paths():
    """For independent paths by their number; one path in one iteration has its own variance."""
    rng = np.random.default_rng(3)
    samples = rng.normal(1.0, 0.1, (64, 32 * WIDTH))
    found = found_in(samples)
    weights = relative_weights(found.mean)
    one, four = (
        direct_paths.direct_error(found, weights, np.full(32 * WIDTH, number), 8, 1.0)
        for number in (1.0, 4.0)
    )
    assert one == pytest.approx(4 * four)
    assert one == pytest.approx(0.01 / 1.1, rel=0.03)
