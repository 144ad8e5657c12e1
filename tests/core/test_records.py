"""Records of mixed fields come back as they were written."""

from mis_integrators.core.records import Layout, word_count

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

COUNT = 37


def numbers(dtype, seed):
    """Random words as a value of a type of numbers."""
    words = np.random.default_rng(seed).integers(1, 1 << 23, (word_count(dtype), COUNT))
    if dr.is_float_v(dtype):
        words = words / 7
    return dtype(*words) if dr.depth_v(dtype) > 1 else dtype(words[0])


def same(a, b):
    return bool(dr.all(a == b, axis=None))


@pytest.mark.parametrize(
    "names",
    [["u"], ["u", "x"], ["v", "u"], ["v", "x", "u"], ["v", "u", "w"], ["x", "v", "w", "u", "y"]],
)
def test_fields_come_back(rgb, names):
    """One word to ten: packets of two, whole packets, and a last packet with a single word."""
    types = {"u": mi.UInt32, "x": mi.Float, "y": mi.Float, "v": mi.Vector3f, "w": mi.Spectrum}
    layout = Layout({name: types[name] for name in names})
    values = {name: numbers(types[name], seed) for seed, name in enumerate(names)}
    words = layout.room(COUNT)
    order = mi.UInt32(np.random.default_rng(1).permutation(COUNT))
    layout.write(words, values, order)
    assert layout.capacity(words) == COUNT
    back = layout.read(words, order)
    assert all(same(back[name], values[name]) for name in names)
    for name in names:
        assert same(layout.read(words, order, only=(name,))[name], values[name])
    moved = layout.read(layout.move(words, order, dr.arange(mi.UInt32, COUNT), True), mi.UInt32(3))
    assert all(same(moved[name], dr.gather(types[name], values[name], 3)) for name in names)


def test_inactive_lanes(rgb):
    """They write nothing and read zero."""
    layout = Layout({"v": mi.Vector3f, "u": mi.UInt32})
    values = {"v": numbers(mi.Vector3f, 1), "u": numbers(mi.UInt32, 2)}
    words, index = dr.zeros(mi.UInt32, layout.words * COUNT), dr.arange(mi.UInt32, COUNT)
    layout.write(words, values, index, index < 5)
    assert same(layout.read(words, index)["u"], dr.select(index < 5, values["u"], 0))
    assert same(layout.read(words, index, index < 3)["u"], dr.select(index < 3, values["u"], 0))


def test_what_a_ray_has_met(rgb):
    """A structure with masks and pointers: from it the surface interaction is made again."""
    scene = mi.load_dict(mi.cornell_box())
    x = np.linspace(-0.9, 0.9, COUNT)
    ray = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(x[::-1].copy()), 3), mi.Vector3f(0.1, 0, -1))
    hit = scene.ray_intersect_preliminary(ray)
    layout = Layout({"hit": mi.PreliminaryIntersection3f})
    words = dr.zeros(mi.UInt32, layout.words * (COUNT + 1))
    layout.write(words, {"hit": hit}, dr.arange(mi.UInt32, COUNT))
    dr.eval(words)
    back = layout.read(words, dr.arange(mi.UInt32, COUNT + 1))["hit"]
    nothing = np.arange(COUNT + 1) == COUNT
    valid = np.array(back.is_valid())
    assert not valid[COUNT] and 0 < np.sum(valid) < COUNT  # some rays pass the box by
    assert np.array_equal(valid[:-1], np.array(hit.is_valid()))
    shapes = np.array(dr.reinterpret_array(mi.UInt32, back.shape))
    assert np.array_equal(shapes[:-1], np.array(dr.reinterpret_array(mi.UInt32, hit.shape)))
    assert shapes[nothing] == 0 and len(set(shapes[:-1])) > 1
    first = hit.compute_surface_interaction(ray)
    ray_of_all = dr.gather(mi.Ray3f, ray, dr.minimum(dr.arange(mi.UInt32, COUNT + 1), COUNT - 1))
    again = back.compute_surface_interaction(ray_of_all)
    assert np.array_equal(np.array(again.p)[:, :-1], np.array(first.p))
    assert np.array_equal(np.array(again.uv)[:, :-1], np.array(first.uv))
