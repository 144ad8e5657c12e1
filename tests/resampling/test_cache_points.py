"""Cache points: which ones a place listens to, and light vertices drawn from their pmfs."""

from mis_integrators.core.random import streams
from mis_integrators.resampling.cache_pmfs import CachePmfs, cumulative_pmfs
from mis_integrators.resampling.cache_points import NORMAL_COST, CacheGrid
from mis_integrators.resampling.proposals import (
    BLIND_SHARE,
    UNIFORM_SHARE,
    Proposals,
    cumulative_sums,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import assert_frequencies


def box_points(count, seed=0, stretch=(1, 1, 1)):
    """Points on the inside of a box, with normals inwards."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(-1, 1, (3, count))
    axis, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    p[axis, np.arange(count)] = side
    n = np.zeros((3, count))
    n[axis, np.arange(count)] = -side
    return p * np.array(stretch)[:, None], n


@pytest.mark.parametrize(
    "count, neighbors, stretch, media",
    [
        (300, 3, (1, 1, 1), False),
        (300, 3, (1, 1, 1), True),
        (77, 5, (10, 1, 0.01), False),
        (2, 3, (1, 1, 1), False),
        (1, 1, (0, 0, 0), True),
    ],
)
def test_neighbours_are_the_nearest(rgb, count, neighbors, stretch, media):
    """Against sorting the same costs in NumPy; places outside the grid get the border's. With media
    a third of cache points and places lie in these."""
    p, n = box_points(count, 1, stretch)
    q, m = box_points(500, 2, 1.3 * np.array(stretch))
    if media:
        n[:, ::3], m[:, ::3] = 0, 0
    grid = CacheGrid(mi.Point3f(p), mi.Normal3f(n), neighbors, media)
    assert np.prod(grid.resolution) <= 1 << 14
    rows = np.array(grid.row(mi.Point3f(q), mi.Normal3f(m)))
    assert rows.max() < grid.rows
    facings = 7 if media else 6
    cell, face = rows // facings, rows % facings
    nx, ny, _ = grid.resolution
    edge = 1 / float(grid._scale[0])
    centre = (np.stack([cell % nx, cell // nx % ny, cell // (nx * ny)]) + 0.5) * edge + p.min(
        axis=1
    )[:, None]
    inside = np.all((q >= p.min(axis=1)[:, None]) & (q < p.max(axis=1)[:, None]), axis=0)
    assert np.all(np.abs(centre - q)[:, inside] <= 0.5001 * edge + 1e-6)
    axis = np.eye(4)[face // 2].T[:3] * np.where(face % 2, -1, 1)
    assert np.all(np.sum(axis * m, axis=0) == (face < 6)) and np.any(face == 6) == media
    other = np.where(
        (face == 6)[:, None], np.sum(n * n, axis=0), 1 - np.sum(axis[:, :, None] * n[:, None], 0)
    )
    cost = np.sum((centre[:, :, None] - p[:, None]) ** 2, axis=0)
    cost += 0.5 * NORMAL_COST * grid.spacing**2 * other
    found = np.array(grid.table).reshape(-1, neighbors)[rows]
    costs = np.take_along_axis(cost, found, axis=1)
    least = np.sort(cost, axis=1)[:, :neighbors]
    assert np.allclose(costs[:, : least.shape[1]], least, rtol=1e-4, atol=1e-4 * grid.spacing**2)


def new_proposals(grid, r, seen, count, width):
    count = dr.opaque(mi.UInt32, count)
    cumulative, uniform = cumulative_sums(r, seen, count, width)
    return Proposals(grid, cumulative, uniform, count, width)


@pytest.mark.parametrize("width, media", [(24, False), (37, True)])
def test_draws_have_their_probability(rgb, width, media):
    """Frequencies of drawn light vertices against the mixture of pmfs computed apart, and against
    `probability`; rows without light are uniform. What is seen is, or in media arrives in part."""
    p, n = box_points(40)
    grid = CacheGrid(mi.Point3f(p), mi.Normal3f(n), 3)
    count, rng = 21, np.random.default_rng(3)
    r = rng.exponential(1, (40, width)) * (rng.random((40, width)) < 0.5)
    r[:, count:] = 0
    table = np.array(grid.table).reshape(-1, 3)
    dark, dominated = (
        0,
        int(np.argmax(np.min(np.abs(table[:, :, None] - table[0]), axis=(1, 2)) > 0)),
    )
    r[table[dark]] = 0
    r[table[dominated, 0], :count] = 1e-12
    r[table[dominated, 0], 4] = 1e12
    seen = rng.random(r.shape) if media else rng.random(r.shape) < 0.3
    seen[table[dominated, 1]] = 0
    kept = (mi.Float if media else mi.Bool)(seen.ravel())
    proposals = new_proposals(grid, mi.Float(r.ravel()), kept, count, width)
    every, some = r.sum(axis=1, keepdims=True), (r * seen).sum(axis=1, keepdims=True)
    blind, open_ = r / np.maximum(every, 1e-30), r * seen / np.maximum(some, 1e-30)
    pmf = np.where(some > 0, (1 - BLIND_SHARE) * open_ + BLIND_SHARE * blind, blind)[:, :count]
    pmf = np.where(every > 0, pmf, 1 / count)
    for row in (dark, dominated, grid.rows - 1):
        share = np.interp(
            (some / np.maximum(every, 1e-30))[table[row]], (0, 1), UNIFORM_SHARE[::-1]
        )
        expected = ((1 - share) * pmf[table[row]] + share / count).mean(axis=0)
        said = np.array(proposals.probability(mi.UInt32(row), dr.arange(mi.UInt32, count)))
        assert np.allclose(said, expected, atol=2e-7) and said.sum() == pytest.approx(1, abs=1e-6)
        drawn = proposals.draw(
            mi.UInt32(row), streams(dr.arange(mi.UInt32, 200000), mi.UInt32(row))
        )
        assert_frequencies(np.bincount(np.array(drawn), minlength=count), 200000 * expected)


def test_no_light_vertices(rgb):
    """All light sub-paths missed the scene: draws are harmless."""
    p, n = box_points(5)
    proposals = new_proposals(
        CacheGrid(mi.Point3f(p), mi.Normal3f(n), 3),
        dr.zeros(mi.Float, 5 * 8),
        dr.full(mi.Bool, True, 5 * 8),
        0,
        8,
    )
    drawn = proposals.draw(
        dr.zeros(mi.UInt32, 100), streams(dr.arange(mi.UInt32, 100), mi.UInt32(0))
    )
    assert np.all(np.array(drawn) == 0)
    assert np.all(np.isfinite(np.array(proposals.probability(dr.zeros(mi.UInt32, 100), drawn))))


def test_draws_from_single_cache_points(rgb):
    """Frequencies of (cache point, light vertex) against the pmfs computed apart, the uniform one
    of the virtual cache point included; from a pmf without light nothing is drawn."""
    p, n = box_points(40)
    grid = CacheGrid(mi.Point3f(p), mi.Normal3f(n), 3)
    count, width, rng = 21, 32, np.random.default_rng(3)
    r = rng.exponential(1, (40, width)) * (rng.random((40, width)) < 0.5)
    r[:, count:] = 0
    table = np.array(grid.table).reshape(-1, 3)
    row = 5
    r[table[row, 1]] = 0
    flat = mi.Float(r.ravel())
    cumulative, totals = cumulative_pmfs(flat, width)
    pmfs = CachePmfs(grid, cumulative, totals, flat, dr.opaque(mi.UInt32, count), width)
    lanes = dr.arange(mi.UInt32, 400000)
    which, vertex, drawn = (
        np.array(x) for x in pmfs.draw(mi.UInt32(row), streams(lanes, mi.UInt32(0)))
    )
    sums = r[table[row]].sum(axis=1, keepdims=True)
    expected = np.concatenate(
        [r[table[row], :count] / np.maximum(sums, 1e-30), np.full((1, count), 1 / count)]
    )
    said = pmfs.probabilities(mi.UInt32(row), dr.arange(mi.UInt32, count))
    assert np.allclose([np.array(x) * np.ones(count) for x in said], expected, atol=2e-7)
    for k in (0, 2, 3):
        found = np.bincount(vertex[(which == k) & drawn], minlength=count)
        assert_frequencies(found, len(which) / 4 * expected[k])
    assert not drawn[which == 1].any() and drawn[which != 1].all()
    asked = pmfs.ratios(mi.UInt32(row), dr.arange(mi.UInt32, count))
    assert np.allclose(asked, r[table[row], :count], rtol=1e-6)
