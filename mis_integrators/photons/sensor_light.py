"""The light that volume photons bring straight to the sensor: light tracing (Dutre, Lafortune and
Willems 1993, Monte Carlo light tracing with direct computation of pixel intensities).

Each photon is joined with the sensor, and is of one pixel only. What beams gather near pixels
share, which a denoiser takes for detail.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.packing import float_bits, read_mark
from ..core.random import next_2d, streams
from ..core.recording import lanes
from ..core.sequences import hash_bits
from ..paths.media import phase_of_photons, transmitted
from ..paths.vertex import Sides
from .photon import read_power
from .volume import landing_of, medium_of, read_places


@dataclass
class SensorLight:
    """Photons joined with the sensor, one a lane.

    `value`: flux times importance (spectrum): its sum over all, over the light sub-paths, is the
    mean radiance of the pixels times their share of the crop window; `film`: position in pixels;
    `depth`: segments of the light sub-path; `delta_at_light`: as of `photon.write_photon`, where
    photons are marked; `active`: seen by the sensor.
    """

    value: mi.Spectrum
    film: mi.Point2f
    depth: mi.UInt32
    delta_at_light: mi.Bool
    active: mi.Bool


def join_photons(world, limits, lens, zone, photons, seed, wavelengths, marked):
    """The `SensorLight` of the volume photons outside of the near `zone` (a `NearZone`). Light
    sub-paths leave none from where the sensor would be a segment too far.

    Parameters
    ----------
    lens
        The sensor's (`Lens`), which connects.
    photons
        As `trace_light_paths` returns them: places, powers, and their number.
    seed
        Of the random numbers, uint32.
    marked
        Whether fluxes have marks.
    """
    place, power, count = photons
    record, active = read_places(place, count)
    landing = landing_of(record)
    active &= ~zone.holds(landing.p)
    index = lanes(dr.width(record["word"]))
    own = mi.UInt32(0)  # not by its place in the buffer, which chance decides
    for coordinate in landing.p:
        own = hash_bits(own + float_bits(coordinate))
    rng = streams(own, seed)
    aperture = next_2d(rng) if lens.sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(lens.sensor.shutter_open())
    d, distance, film, density, active = lens.connect(landing.p, time, aperture, active)
    flux, towards = read_power(power, index, active)
    delta_at_light = mi.Bool(False)
    if marked:
        flux, delta_at_light = read_mark(flux)
    medium = medium_of(dr.select(active, landing.medium, 0))
    sides = Sides(medium, medium, landing.p, wavelengths)
    where = medium, landing.p, wavelengths, d, dr.normalize(towards), active
    phase, _, adjoint = phase_of_photons(world.traits, *where)
    phase *= adjoint
    active &= dr.max(phase) > 0
    way = landing.p, mi.Normal3f(0), sides, d, distance, wavelengths
    kept = transmitted(world.scene, world.traits, *way, rng, active, limits.hide_emitters)
    value = flux * phase * kept * density
    active &= dr.max(value) > 0
    return SensorLight(dr.select(active, value, 0), film, landing.depth, delta_at_light, active)
