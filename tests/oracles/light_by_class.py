"""Light by class of its paths, in the plainest way: camera paths that sample BSDFs until they meet
an emitter by chance. Nothing here is of the package."""

import drjit as dr
import mitsuba as mi
import numpy as np


@dr.syntax
def traced(scene, sensor, spp: int, seed: int, max_depth: int):
    """`spp` independent paths through each pixel of a film with a box filter.

    Returns an array (height, width, 3, channels): for `direct`, `indirect` and `caustic` the
    radiance of paths of up to `max_depth` segments."""
    width, height = (int(edge) for edge in sensor.film().size())
    index = dr.arange(mi.UInt32, width * height * spp)
    pixel = index // spp
    rng = mi.PCG32(size=width * height * spp, initstate=seed)
    x = (mi.Float(pixel % width) + rng.next_float32()) / width
    y = (mi.Float(pixel // width) + rng.next_float32()) / height
    ray, weight = sensor.sample_ray(
        0, rng.next_float32(), mi.Point2f(x, y), mi.Point2f(rng.next_float32(), rng.next_float32())
    )
    throughput, active = mi.Spectrum(weight), mi.Bool(True)
    direct, indirect, caustic = mi.Spectrum(0), mi.Spectrum(0), mi.Spectrum(0)
    smooth, depth, last_was_delta = mi.UInt32(0), mi.UInt32(0), mi.Bool(False)
    while active:
        si = scene.ray_intersect(ray, active)
        light = dr.select(active, throughput * si.emitter(scene, active).eval(si, active), 0)
        is_direct = (smooth == 0) | ((smooth == 1) & ~last_was_delta)
        is_caustic = (smooth > 0) & last_was_delta
        direct += dr.select(is_direct, light, 0)
        caustic += dr.select(is_caustic, light, 0)
        indirect += dr.select(~is_direct & ~is_caustic, light, 0)
        depth += 1
        active &= si.is_valid() & (depth < max_depth)
        bs, factor = si.bsdf(ray).sample(
            mi.BSDFContext(),
            si,
            rng.next_float32(active),
            mi.Point2f(rng.next_float32(active), rng.next_float32(active)),
            active,
        )
        throughput *= factor
        last_was_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth += dr.select(last_was_delta, mi.UInt32(0), mi.UInt32(1))
        ray = si.spawn_ray(si.to_world(bs.wo))
    classes = np.stack([np.array(light) for light in (direct, indirect, caustic)])
    return classes.reshape(3, -1, height, width, spp).mean(axis=-1).transpose(2, 3, 0, 1)
