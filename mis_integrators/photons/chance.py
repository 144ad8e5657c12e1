"""Lights that camera paths meet by chance behind delta surfaces.

Photons bring that light, too, to the last smooth vertex before. Both count, under the balance
heuristic (Veach 1997, section 9.2.2). Between the vertex and the light all scattering is by delta
functions. Along such a path etendue, dA cos dw, stays as it is. So the density per etendue with
which light sub-paths start, D, is that with which they arrive: N of them leave N pi r^2 D cos
photons per solid angle in the vertex' merge disk. One camera path goes there with the density p of
the BSDF. With x = N pi r^2 D cos / p, photons have the weight x / (1 + x), and lights that are met
1 / (1 + x).

Left out are roulette, the choices at delta surfaces (taken as alike from both sides), and that
etendue changes with the squared index of refraction. Weights are functions of the path all the
same.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..core.spectra import channel_mean
from ..paths.light_starts import seen_from
from .kernel_sums import disk_area

NEVER_MET = 1e30
"""D of light that no camera path can meet."""
SMALLEST_PDF = 1e-30
LARGEST_RATIO = 1e30


def can_meet_lights(scene):
    """Whether a camera path meets one light at most behind the delta surfaces after a smooth
    vertex: none of these shines itself."""
    return not any(
        shape.is_emitter() and shape.bsdf().flags() & mi.BSDFFlags.Delta for shape in scene.shapes()
    )


def start_density(lights, ref, ds, active):
    """D [1/(m^2 sr)] of light sub-paths from the light's point or direction of `ds` to `ref`."""
    met = lights.can_be_met(ds.emitter, active)
    density = lights.pdf_emission_origin(ref, ds, met) * lights.pdf_emission_area(ref, ds, met)
    return dr.select(met, density, NEVER_MET)


class StartDensity:
    """What photons carry (a `mis.state.LightState`): their D."""

    def __init__(self, lights):
        self.lights, self.layout = lights, Layout({"density": mi.Float})

    def init(self):
        return [mi.Float(NEVER_MET)]

    def first_vertex(self, state, si, source, straight):
        density = start_density(self.lights, si, seen_from(si, source, straight), straight)
        return [dr.select(straight, density, state[0])]

    def scatter(self, state, si, bsdf, wo, mask):
        return state

    def words(self, state):
        return self.layout.flat({"density": state[0]})

    def read(self, photon_map, index, active):
        """D of photons of a map."""
        place = photon_map.place_of_mis_words(index, active)
        return self.layout.read(photon_map.mis_words, place, active)["density"]


# ---------------------------------------------------------------------- weights


def x_of(light_paths, radius, ratio):
    """x, by the `ratio` D cos / p [1/m^2]."""
    return dr.minimum(light_paths * disk_area(radius) * ratio, LARGEST_RATIO)


def weight_of_photon(x):
    return x * dr.rcp(1 + x)


def weight_of_hit(x):
    return dr.rcp(1 + x)


def ratio_of(density, cosine, pdf):
    """D cos / p."""
    return density * cosine * dr.rcp(dr.maximum(pdf, SMALLEST_PDF))


def photon_weigher(lights, light_paths, vertices):
    """What makes, of a map and radii, the weights of its photons at `vertices` (`weigh` of
    `gather_photons`)."""
    carried = StartDensity(lights)

    def weigher(photon_map, radii):
        def weigh(index, landing, scattering, active):
            density = carried.read(photon_map, index, active)
            # Both cosines grow alike with the length of `towards`.
            cosine = dr.abs(dr.dot(vertices.n, scattering.towards))
            ratio = ratio_of(density, cosine, scattering.p * scattering.shading)
            return [weight_of_photon(x_of(light_paths, radius, ratio)) for radius in radii]

        return weigh

    return weigher


# ---------------------------------------------------------------------- lights that are met


def hit_layout():
    """What a camera vertex keeps of the light that its path has met: radiance, `light`, throughput
    included; its `ratio` D cos / p; and the `flux` of photons that come from there (for one light
    sub-path, channel mean)."""
    return Layout({"light": mi.Spectrum, "ratio": mi.Float, "flux": mi.Float})


def write_hit(hits, slot, lights, si, ray, light, left, cosine, pdf, active):
    """Keeps `light` that a `ray` has met at `si` at the places `slot`. The path left its last
    smooth vertex with the mean throughput `left`, at `cosine` to the normal, with density `pdf`."""
    ref = dr.zeros(mi.Interaction3f)
    ref.p, ref.time, ref.wavelengths = ray.o, ray.time, ray.wavelengths
    density = start_density(lights, ref, mi.DirectionSample3f(lights.scene, si, ref), active)
    sent = left * density
    hit = {
        "light": light,
        "ratio": ratio_of(density, cosine, pdf),
        "flux": dr.select(sent > 0, channel_mean(light) * dr.rcp(sent), 0),
    }
    hit_layout().write(hits, hit, slot, active)
