"""Recorded passes: the second and all later calls, which launch the recording's kernels, do all
that the first one did."""

import gc

from mis_integrators.core.recording import frozen, lanes, no_garbage_collection
from mis_integrators.core.traits import children

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from selection import extended


@pytest.fixture
def scene(rgb):
    """Shapes whose BSDFs differ, so that asking them is a virtual function call with data of its
    own."""
    spheres = {
        f"s{i}": {"type": "sphere", "center": [3 * i, 0, 0], "bsdf": bsdf}
        for i, bsdf in enumerate(
            [
                {"type": "diffuse"},
                {"type": "roughplastic", "alpha": 0.3},
                {"type": "twosided", "bsdf": {"type": "roughconductor"}},
            ]
        )
    }
    return mi.load_dict({"type": "scene", **spheres})


def ask(count):
    """A pass of so many lanes with nothing but gathers and a virtual call."""

    def launch(shapes, weights):
        index = lanes(count)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(0, 0.6, 0.8)
        shape = dr.gather(mi.ShapePtr, shapes, index % 3)
        return dr.mean(
            shape.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0.6, 0, 0.8))
        ) * dr.gather(mi.Float, weights, index % 5)

    return launch


MULTIPLES = range(64, 4097, 64)


@pytest.mark.parametrize("counts", [(64, 192, 768, 3072), *extended(MULTIPLES)], ids=len)
def test_replays_have_all_their_lanes(scene, counts):
    """Of sizes that are multiples of 64, as the data of a virtual call have: Dr.Jit 1.5 would take
    these four, and others that are multiples of 192, for the size of that."""
    shapes, weights = scene.shapes_dr(), mi.Float([1, 2, 3, 4, 5])
    dr.eval(shapes, weights)
    short = []
    for count in counts:
        recorded = frozen(ask(count))
        first, again = (np.array(recorded(shapes, weights)) for _ in range(2))
        assert first.shape == (count,) and np.all(first > 0)
        if again.shape != first.shape or not np.array_equal(first, again):
            short.append((count, again.shape))
    assert not short


def test_lanes_count(rgb):
    assert np.array_equal(np.array(lanes(5)), np.arange(5))
    recorded = frozen(lambda scale: lanes(7) * scale)
    for scale in (2, 3):
        assert np.array_equal(np.array(recorded(dr.opaque(mi.UInt32, scale))), scale * np.arange(7))
    assert np.array_equal(np.array(lanes(5)), np.arange(5))  # nothing of the recording is left


def test_lists_of_objects_keep_none_alive(rgb):
    """Objects of a scene that is gone must not wait for the garbage collector, which may come while
    their kind is being called."""
    scene = mi.load_dict({"type": "scene", "lamp": {"type": "point"}})
    with no_garbage_collection():
        found = children(scene, mi.Object)
        holders = [type(holder).__name__ for holder in gc.get_referrers(found)]
    assert len(found) == 1 and not {"cell", "dict"} & set(holders)
