"""Weights of caustic light that both photons and chance bring: behind delta surfaces camera paths
may meet a light.

Photons bring that light, too, to the last smooth vertex before. Both count, under the balance
heuristic (Veach 1997, section 9.2.2). Between the vertex and the light all scattering is by delta
functions. Along such a path etendue, dA cos dw, stays as it is. So the density per etendue with
which light sub-paths start, D, is that with which they arrive: N of them leave N pi r^2 D cos
photons per solid angle in the vertex' merge disk. One camera path goes there with the density p of
the BSDF. With x = N pi r^2 D cos / p, photons have the weight x / (1 + x), and lights that are met
1 / (1 + x).

Photons that carry D also tell how noisy camera paths alone would be there, which a few of them
cannot: see `second_moment`.

Left out are roulette, transmittance of media, the choices at delta surfaces (taken as alike from
both sides), and that etendue changes with the squared index of refraction. Weights are functions of
the path all the same; but where the radius depends on a photon's flux, that of a photon which has
survived roulette on its way is a little larger than that of a hit.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..core.spectra import channel_mean
from ..lights.lights import NEVER_MET
from ..paths.light_classes import CAUSTIC, CLASSES
from ..paths.light_starts import light_seen_from
from ..photons.hits import density_ratio
from ..photons.kernel_sums import disk_area
from ..photons.photon import read_power
from ..weights.heuristics import bounded_power, weight


def x_of(light_paths, radius, ratio):
    """x, by the `ratio` D cos / p [1/m^2]."""
    return light_paths * disk_area(radius) * ratio


def weight_of_photon(x):
    return weight(0, bounded_power(dr.rcp(x), 1))


def weight_of_hit(x):
    return weight(0, bounded_power(x, 1))


class StartDensity:
    """What photons on surfaces carry: their D (a `mis.state.LightState`)."""

    in_media = False

    def __init__(self, lights):
        self.lights, self.layout = lights, Layout({"density": mi.Float})

    def init(self):
        return [mi.Float(NEVER_MET)]

    def first_vertex(self, state, si, source, straight):
        density = self.lights.start_density(si, light_seen_from(si, source, straight), straight)
        return [dr.select(straight, density, state[0])]

    def scatter(self, state, si, bsdf, wo, mask):
        return state

    def words(self, state):
        return self.layout.flat({"density": state[0]})

    def read(self, photon_map, index, active):
        """D of photons of a map."""
        place = photon_map.place_of_mis_words(index, active)
        return self.layout.read(photon_map.mis_words, place, active)["density"]


def second_moment(lights, photon_map, vertices):
    """What multiplies what caustic photons of a map bring to `vertices`, so that the sum is the
    second moment of one camera path that goes on there and meets their light (`weigh` of
    `gather_photons`).

    Such a path brings f L cos / p, with density p. So the moment is the integral of f L cos times
    f L cos / p: photons sample the first factor, and their radiance is flux times D.
    """
    carried = StartDensity(lights)

    def weigh(index, landing, scattering, active):
        flux, _ = read_power(photon_map.power, index, active)
        density = carried.read(photon_map, index, active)
        active = active & (density < NEVER_MET)
        light = channel_mean(vertices.factor * scattering.value) * channel_mean(flux)
        ratio = density_ratio(density, 1, scattering.p * scattering.shading)  # the cosine is in f
        return dr.select(active, light * ratio, 0)

    return weigh


class ChanceWeights:
    """Weights at `vertices` that caustic photons and `hits` (records of `hits.chance_layout`)
    reach. `light_paths`: N."""

    def __init__(self, lights, light_paths, vertices, hits):
        self.carried, self.light_paths = StartDensity(lights), light_paths
        self.vertices, self.hits = vertices, hits

    def weigher(self, photon_map, radii):
        """What weighs the photons of a map, for each radius (`weigh` of `gather_photons`)."""

        def weigh(index, landing, scattering, active):
            density = self.carried.read(photon_map, index, active)
            # Both cosines grow alike with the length of `towards`.
            cosine = dr.abs(dr.dot(self.vertices.n, scattering.towards))
            ratio = density_ratio(density, cosine, scattering.p * scattering.shading)
            return [weight_of_photon(x_of(self.light_paths, radius, ratio)) for radius in radii]

        return weigh

    def with_hits(self, found, radii, grey):
        """What photons bring for each radius (and class: see `gather_photons`), with the weighted
        hits."""
        classes = len(found) // len(radii)
        place = CLASSES.index(CAUSTIC) if classes > 1 else 0
        light = dr.select(self.vertices.active, self.hits["light"], 0)
        for number, radius in enumerate(radii):
            value = light * weight_of_hit(x_of(self.light_paths, radius, self.hits["ratio"]))
            found[number * classes + place] += channel_mean(value) if grey else value
        return found
