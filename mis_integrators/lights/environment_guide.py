"""Where light from infinitely far away should start so that it reaches what the camera sees.

A sun, a sky or an environment map sends its sub-paths through the disk of the whole scene's
bounding sphere; through a window, almost none would enter. A pilot of camera paths asks from which
directions, and through which part of the plane across each direction, the places that matter are
lit. Sub-paths then start mostly there: a histogram over (direction cell, position cell), and one
over the faces of the box around the lit places (`portals`), mixed with the plain densities, which
keeps every estimate unbiased however poor the pilot. The latter also tells next-event estimation
where the windows are, if that makes less noise.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.random import next_2d, streams
from ..core.spectra import channel_mean
from ..core.traits import scene_bounds
from ..paths.camera_rays import sample_camera_ray
from .environment_sampler import EnvironmentSampler, point, radiance
from .histograms import draw_cell, in_square_cell, smoothed, split, square_cell
from .portals import PortalDistribution

POLAR_CELLS = 16
"""Tuned: cells of directions from pole to pole."""
AZIMUTH_CELLS = 32
"""Tuned: cells of directions around."""
POSITION_CELLS = 64
"""Tuned: cells along each edge of the position histograms."""
DEFENSIVE_SHARE = 0.2
"""Tuned: share of sub-paths that start anywhere on the scene's disk."""
ENOUGH_RECORDS = 256
"""Tuned: records of a direction cell at which its own histogram has as large a share as the one
over the faces of the box, which serves all of them."""
PILOT_PATHS = 65536
"""Tuned: camera paths of the pilot."""
PILOT_BOUNCES = 4
"""Tuned: vertices of each."""
TESTS = 2
"""Tuned: directions in which each place of the pilot looks for an environment, once these are
known."""
PASS_THROUGH = 8
"""Transmissive surfaces that the pilot's visibility test looks straight through (panes, masks)."""
LEVEL_SHARES = (0.55, 0.25, 0.1, 0.1)
"""Tuned: shares of the position histogram at full, half, quarter and eighth resolution."""
FEWEST_RECORDS = 64
"""Tuned: records, fewer than which tell nothing."""
AIMED_SHARE = 0.5
"""Tuned: share of the directions of direct light that are aimed at the entrances, if any are."""
WORTH_AIMING = 0.9
"""Tuned: none are if that leaves more than this of the noise."""
JUMP = -1.37e-4
"""Third coordinate of the directions where the axes across them jump, see `_across`: no light has
just that."""
FOCUS_TAIL = 0.01
"""Tuned: share of the records' weight that may lie outside the focus, at each end of each axis."""
FOCUS_MARGIN = 0.25
"""Tuned: none, where so much more of the focus' edge would take in all of it, as in a room: light
that falls beside the focus is that of few sub-paths, whose photons are as heavy as hundreds of
others."""


def infinite_emitters(scene):
    """Indices and emitters whose light comes from infinitely far away."""
    return [(i, e) for i, e in enumerate(scene.emitters()) if e.flags() & mi.EmitterFlags.Infinite]


def direction_cells():
    """Cells of all directions."""
    return POLAR_CELLS * AZIMUTH_CELLS


def direction_cell(d):
    """Cell number of world directions on an equal-area grid."""
    row = dr.clip(mi.UInt32((d.z + 1) * (0.5 * POLAR_CELLS)), 0, POLAR_CELLS - 1)
    azimuth = dr.atan2(d.y, d.x) * dr.inv_two_pi
    azimuth = dr.select(azimuth < 0, azimuth + 1, azimuth)
    column = dr.clip(mi.UInt32(azimuth * AZIMUTH_CELLS), 0, AZIMUTH_CELLS - 1)
    return row * AZIMUTH_CELLS + column


def cell_direction(cell, sample):
    """A direction uniformly distributed in direction cell `cell`."""
    z = (mi.Float(cell // AZIMUTH_CELLS) + sample.x) * (2 / POLAR_CELLS) - 1
    phi = (mi.Float(cell % AZIMUTH_CELLS) + sample.y) * (2 * dr.pi / AZIMUTH_CELLS)
    sin_phi, cos_phi = dr.sincos(phi)
    radius = dr.safe_sqrt(1 - z * z)
    return mi.Vector3f(radius * cos_phi, radius * sin_phi, z)


def _across(towards):
    """Two unit vectors across a direction and each other (Duff et al. 2017, Building an orthonormal
    basis, revisited). As `mi.Frame3f`, but that jumps where z changes its sign, and strategies
    round the direction of a sun, of which a coordinate often is zero, to either side."""
    x, y, z = towards
    sign = dr.select(z > JUMP, mi.Float(1), -1)
    a = -dr.rcp(sign + z)
    b = x * y * a
    s = mi.Vector3f(1 + sign * dr.square(x) * a, sign * b, -sign * x)
    return s, mi.Vector3f(b, sign + dr.square(y) * a, -y)


def _weighted_box(points, weights, tail):
    """Low and high corner of the box that leaves at most the share `tail` of the weight outside at
    each end of each axis; none where the last point is within `FOCUS_MARGIN` of the end."""
    corners = []
    for axis in points:
        order = np.argsort(axis)
        share = np.cumsum(weights[order]) / weights.sum()
        low = axis[order[np.searchsorted(share, tail)]]
        high = axis[order[min(np.searchsorted(share, 1 - tail), len(order) - 1)]]
        margin = FOCUS_MARGIN * (high - low)
        first, last = axis.min(), axis.max()
        corners.append(
            (first if first >= low - margin else low, last if last <= high + margin else high)
        )
    return np.array(corners).T


@dr.syntax
def _sees_sky(scene, ray, active):
    """Whether rays escape from the scene, looking straight through panes and masks."""
    ray = mi.Ray3f(ray)
    pending = mi.Bool(active)
    reached = mi.Bool(active)
    left = mi.UInt32(PASS_THROUGH)
    while dr.hint(pending, label="sky test"):
        hit = scene.ray_intersect(
            ray, mi.RayFlags.Minimal, coherent=False, reorder=False, active=pending
        )
        flags = hit.bsdf().flags()
        through = mi.has_flag(flags, mi.BSDFFlags.Null) | mi.has_flag(
            flags, mi.BSDFFlags.DeltaTransmission
        )
        left -= 1
        pending &= hit.is_valid()
        reached &= ~pending | (through & (left > 0))
        pending &= through & (left > 0)
        ray = hit.spawn_ray(ray.d)
    return reached


def _aimed_density(portals, own_pdf, p, towards, active=True):
    """Density per solid angle of directions from `p` of which, near the entrances, the
    `AIMED_SHARE` is aimed at these; all others have density `own_pdf`."""
    near = active & portals.near(p)
    mixed = (1 - AIMED_SHARE) * own_pdf + AIMED_SHARE * portals.direction_density(p, towards, near)
    return dr.select(near, mixed, own_pdf)


def _worth_aiming(portals, p, d, light, density, own):
    """Whether direct light is less noisy with the `AIMED_SHARE` of its directions aimed at the
    entrances.

    Records (NumPy arrays): places `p` and directions `d` (3, n) to environments that a shadow ray
    reaches, `light` from there, densities per solid angle with which they were drawn, and with
    which the `EnvironmentSampler` draws them. At a place, light has the second moment of its ratio
    to the density of its direction; here that is taken relative to the light, so that dark places
    count as much as bright ones.
    """
    if len(light) < FEWEST_RECORDS:
        return False
    aimed = np.array(_aimed_density(portals, mi.Float(own), mi.Point3f(p), mi.Vector3f(d)))
    return np.sum(light * density / aimed) < WORTH_AIMING * np.sum(light * density / own)


def _joined(arrays):
    """Arrays of `PILOT_PATHS` lanes, or one, one after the other."""
    kind = type(arrays[0])
    if dr.depth_v(kind) > 1:
        return kind(*(_joined(parts) for parts in zip(*arrays)))
    return dr.concat([dr.repeat(array, PILOT_PATHS // dr.width(array)) for array in arrays])


class Places(NamedTuple):
    """Surfaces that camera paths have met: their BSDFs, the paths' throughput, and where they
    scatter smoothly."""

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    throughput: mi.Spectrum
    smooth: mi.Bool


class Turn(NamedTuple):
    """Directions of next-event estimation that an environment's own sampler does not draw."""

    counted: mi.Bool
    """Which lanes have the density `EnvironmentGuide.direct_density`, and not just that of the own
    sampler."""
    turned: mi.Bool
    """Which of these have the direction `towards`."""
    towards: mi.Vector3f
    good: mi.Bool
    """Whether that is any good."""
    sample: mi.Point2f
    """What is left of the pairs of uniform numbers, for the own sampler."""


class EnvironmentGuide:
    """Densities of position and direction for infinite emitters (`environment` and `directional`
    kinds).

    Attributes: `sampler`, the `EnvironmentSampler` (`None` without an environment); `center`,
    `radius` of the scene's bounding sphere; `focus_center`, `focus_radius` of the lit places that
    the pilot met; `portals` of the light of environments (`None` where the pilot saw next to none);
    `direction_share`, the share of environment sub-paths whose direction comes from the `sampler`;
    `aims`, whether next-event estimation in the box around the lit places aims at the entrances.
    Without a `sensor` (None) there is no pilot: positions have the plain density, and directions
    that of the `sampler`.
    """

    def __init__(self, scene, sensor):
        box = scene_bounds(scene)
        low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
        self._set_sphere((low + high) / 2, np.linalg.norm(high - low) / 2 or 1.0)
        self.scene = scene
        self.infinite = infinite_emitters(scene)
        first_rows, row = np.zeros(len(scene.emitters()), dtype=np.uint32), 0
        for index, emitter in self.infinite:
            first_rows[index] = row
            row += direction_cells() if emitter.is_environment() else 1
        self.row_count = row
        self._first_row = from_numpy(mi.UInt32, first_rows)
        self.direction_share = 1.0
        self.portals = None
        self.aims = False
        self.sampler = next(
            (EnvironmentSampler(e) for _, e in self.infinite if e.is_environment()), None
        )
        if sensor is None:
            self._keep(np.zeros((self.row_count, POSITION_CELLS**2)), np.zeros(0, np.uint32))
        else:
            self._learn(sensor)

    def _set_sphere(self, center, radius):
        self.center, self.radius = mi.Point3f([float(x) for x in center]), float(radius) * 1.001
        self.focus_center, self.focus_radius = mi.Point3f(self.center), self.radius

    def tables(self):
        """Every evaluated array that the sampling routines read, for `dr.freeze` to track."""
        arrays = [
            self.center,
            self.focus_center,
            self._first_row,
            self._pmf,
            self._cdf,
            self._guided,
        ]
        if self.portals is not None:
            arrays += [self._entering, *self.portals.tables()]
        if self.sampler is not None:
            arrays += self.sampler.tables()
        return arrays + (
            [self._direction_pmf, self._direction_cdf] if self.direction_share < 1 else []
        )

    def row_of_emitter(self, index):
        """First table row of emitter `index`: the only one of a directional emitter."""
        return dr.gather(mi.UInt32, self._first_row, index)

    # ------------------------------------------------------------------ pilot

    def _learn(self, sensor):
        places, rng = self._places(sensor)
        self._learn_directions(places, rng)
        records = [
            [np.array(x) for x in self._look(index, emitter, places, rng)]
            for index, emitter in self.infinite
            for _ in range(TESTS if emitter.is_environment() else 1)
        ]
        p, d, row, weight, density, own = (np.concatenate(x, axis=-1) for x in zip(*records))
        useful = (weight > 0) & np.isfinite(weight)
        p, d, row, weight, density, own = (
            x[..., useful] for x in (p, d, row, weight, density, own)
        )
        cells = POSITION_CELLS**2
        pmf = np.zeros((self.row_count, cells))
        if len(row) >= FEWEST_RECORDS:
            weight = np.minimum(weight, 20 * np.mean(weight))
            low, high = _weighted_box(p, weight, FOCUS_TAIL)
            # An even flux is what merging wants, and heavy records (a glossy peak, a texel of the
            # sun) guide no better than others.
            light, weight = weight, np.sqrt(weight)
            center, radius = (
                (low + high) / 2,
                max(np.linalg.norm(high - low) / 2, 1e-4 * self.radius),
            )
            self.focus_center, self.focus_radius = (
                mi.Point3f([float(x) for x in center]),
                float(radius) * 1.05,
            )
            cell, inside = (np.array(x) for x in self._position_cell(mi.Vector3f(d), mi.Point3f(p)))
            pmf += np.bincount((row * cells + cell)[inside], weight[inside], pmf.size).reshape(
                pmf.shape
            )
            entering = self._environment_rows()[row]
            if np.count_nonzero(entering) >= FEWEST_RECORDS:

                def portals(records):
                    return PortalDistribution(
                        low, high, p[:, records], d[:, records], weight[records]
                    )

                self.portals = portals(entering)
                # What half of the records have taught is tried on the others: a histogram knows
                # those too well that it was made from.
                odd = np.cumsum(entering) % 2 == 1
                self.aims = _worth_aiming(
                    portals(entering & odd),
                    *(x[..., entering & ~odd & (own > 0)] for x in (p, d, light, density, own)),
                )
        self._keep(pmf, row)

    def _keep(self, pmf, row):
        """Makes the tables. `pmf`: weights of the records by table row and position cell; `row`:
        the records' rows."""
        cells = POSITION_CELLS**2
        seen = pmf.any(axis=1)
        found = smoothed(pmf[seen].reshape(-1, POSITION_CELLS, POSITION_CELLS), LEVEL_SHARES)
        found = found.reshape(-1, cells)
        total = np.zeros(self.row_count)
        total[seen] = found.sum(axis=1)
        found /= np.maximum(total[seen], 1e-300)[:, None]
        table = np.zeros((self.row_count, cells), np.float32)
        table[seen] = found
        self._pmf = from_numpy(mi.Float, table.ravel())
        table[seen] = np.cumsum(found, axis=1)
        self._cdf = from_numpy(mi.Float, table.ravel())
        guided = np.where(total > 0, 1 - DEFENSIVE_SHARE, 0.0)
        if self.portals is not None:
            met = np.bincount(row, minlength=self.row_count)
            entering = np.where(
                self._environment_rows(),
                (1 - DEFENSIVE_SHARE) * ENOUGH_RECORDS / (ENOUGH_RECORDS + met),
                0.0,
            )
            guided -= np.where(guided > 0, entering, 0)
            self._entering = from_numpy(mi.Float, entering)
        self._guided = from_numpy(mi.Float, guided)

    def _environment_rows(self):
        """Which table rows are an environment's: (row_count,)."""
        rows = np.zeros(self.row_count, dtype=bool)
        for index, emitter in self.infinite:
            if emitter.is_environment():
                first = int(np.array(self._first_row)[index])
                rows[first : first + direction_cells()] = True
        return rows

    def _learn_directions(self, places, rng):
        """Direction cells by (radiance without its sharp peaks) x (share of the places that see the
        sky there)."""
        environment = next(((i, e) for i, e in self.infinite if e.is_environment()), None)
        if environment is None:
            return
        _, emitter = environment
        towards = mi.warp.square_to_uniform_sphere(next_2d(rng))
        dr.eval(towards, rng)
        response, reached, _ = self._test(places, towards, places.smooth)
        cell, tested, reached = (
            np.array(x) for x in (direction_cell(towards), response > 0, reached)
        )
        tests = np.bincount(cell[tested], minlength=direction_cells())
        seen = np.bincount(cell[reached], minlength=direction_cells())
        reach = seen / np.maximum(tests, 1)
        draws = 64
        cell = dr.arange(mi.UInt32, direction_cells() * draws) // draws
        rng = streams(dr.arange(mi.UInt32, direction_cells() * draws), mi.UInt32(0x64697273))
        smooth = radiance(emitter, cell_direction(cell, next_2d(rng))).numpy().reshape(-1, draws)
        smooth = np.minimum(
            smooth, 4 * np.median(smooth, axis=1, keepdims=True) + 1e-6 * smooth.mean()
        ).mean(axis=1)
        smooth_power = smooth * reach * (4 * np.pi / direction_cells())
        total_power = self.sampler.power(direction_cell, direction_cells())
        if smooth_power.sum() <= 0:
            return
        self.direction_share = float(
            np.clip(1 - smooth_power.sum() / max((total_power * reach).sum(), 1e-30), 0.25, 0.9)
        )
        pmf = smooth_power / smooth_power.sum()
        self._direction_pmf = from_numpy(mi.Float, pmf)
        self._direction_cdf = from_numpy(mi.Float, np.cumsum(pmf))

    def _places(self, sensor):
        """Places that matter: the first surfaces of camera paths, and random numbers for each.

        Their segments are intersected again, all at once: what looks from the places is then traced
        once, which with many BSDFs takes longer than the rays."""
        rng = streams(dr.arange(mi.UInt32, PILOT_PATHS), mi.UInt32(0x67756964))
        wavelength_sample = 0.5
        ray, throughput = sample_camera_ray(
            sensor, sensor.shutter_open(), wavelength_sample, next_2d(rng), next_2d(rng)
        )
        throughput = mi.Spectrum(throughput) + dr.zeros(mi.Spectrum, PILOT_PATHS)
        active = dr.full(mi.Bool, True, PILOT_PATHS)
        segments = []
        for bounce in range(PILOT_BOUNCES):
            ray.maxt, ray.time = (x + dr.zeros(mi.Float, PILOT_PATHS) for x in (ray.maxt, ray.time))
            dr.make_opaque(ray, active, throughput, rng)  # so that all have the same kernel
            segments.append((ray.o, ray.d, ray.maxt, ray.time, ray.wavelengths, throughput, active))
            if bounce == PILOT_BOUNCES - 1:
                break
            si = self.scene.ray_intersect(ray, active)
            active = active & si.is_valid()  # not in place: the segment keeps its own
            bs, value = si.bsdf().sample(
                mi.BSDFContext(), si, rng.next_float32(), next_2d(rng), active
            )
            throughput = throughput * value
            active = active & (channel_mean(throughput) > 0)
            ray = si.spawn_ray(si.to_world(bs.wo))
            dr.eval(ray, active, throughput, rng)
        *ray, throughput, active = (_joined(arrays) for arrays in zip(*segments))
        si = self.scene.ray_intersect(mi.Ray3f(*ray), active)
        bsdf = si.bsdf()
        smooth = active & si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        own = streams(dr.arange(mi.UInt32, PILOT_BOUNCES * PILOT_PATHS), mi.UInt32(0x706C6163))
        dr.eval(si, smooth, own)
        return Places(si, bsdf, throughput, smooth), own

    def _test(self, places, towards, active):
        """What the places make of light from `towards`: their BSDF's value, whether a ray gets
        there through panes, and whether nothing at all is in its way. Evaluated, as the arguments
        are to be: all tests have the same kernel, which with many BSDFs takes long to compile."""
        value = places.bsdf.eval(mi.BSDFContext(), places.si, places.si.to_local(towards), active)
        response = dr.select(active, channel_mean(value), 0)
        ray = places.si.spawn_ray(towards)
        reached = _sees_sky(self.scene, ray, active & (response > 0))
        direct = reached & ~self.scene.ray_test(ray, reached)
        dr.eval(response, reached, direct)
        return response, reached, direct

    def _look(self, index, emitter, places, rng):
        """Records (p, direction to the light, table row, weight, density, own density) of a place
        each, where sub-paths of the emitter would come from; the weight estimates what light from
        there adds to the image. The densities of the direction, and of the `sampler` there, are
        zero but for environments; the latter also where next-event estimation has something in its
        way."""
        vertices = dr.width(places.smooth)
        pdf = own = dr.zeros(mi.Float, vertices)
        if emitter.is_environment():
            towards, pdf, row, _ = self.sample_direction(
                emitter,
                mi.UInt32(index),
                places.si,
                next_2d(rng),
                rng.next_float32(),
                places.smooth,
            )
            light = radiance(emitter, towards, places.smooth) * dr.select(pdf > 0, dr.rcp(pdf), 0)
        else:
            ds, irradiance = emitter.sample_direction(places.si, next_2d(rng), places.smooth)
            towards, light, row = (
                ds.d,
                channel_mean(irradiance),
                self.row_of_emitter(mi.UInt32(index)),
            )
        lit = places.smooth & (light > 0)
        dr.eval(towards, light, pdf, row, lit, rng)
        response, reached, direct = self._test(places, towards, lit)
        if emitter.is_environment():
            ds = dr.zeros(mi.DirectionSample3f, vertices)
            ds.d = towards
            own = emitter.pdf_direction(places.si, ds, direct)
            own = dr.select(direct, self.sampler.density(own, towards, direct), 0)
        weight = dr.select(
            reached, light * channel_mean(places.throughput) * dr.minimum(response, 1), 0
        )
        record = (
            places.si.p,
            *(x + dr.zeros(type(x), vertices) for x in (towards, row, weight, pdf, own)),
        )
        dr.eval(record)
        return record

    # ------------------------------------------------------------------ densities

    def _position_cell(self, towards, p):
        """Cell of the focus grid that a line along `towards` through `p` crosses, and whether it
        crosses the grid."""
        s, t = _across(towards)
        offset = (p - self.focus_center) * (1 / self.focus_radius)
        u, v = dr.dot(offset, s), dr.dot(offset, t)
        return square_cell(0.5 * (u + 1), 0.5 * (v + 1), POSITION_CELLS), (dr.abs(u) <= 1) & (
            dr.abs(v) <= 1
        )

    def position_density(self, towards, row, p, active=True):
        """Density per unit area (across `towards`) of sub-paths along the line through `p`."""
        cell, inside = self._position_cell(towards, p)
        guided = dr.gather(mi.Float, self._guided, row, active)
        probability = dr.gather(
            mi.Float, self._pmf, row * POSITION_CELLS**2 + cell, active & inside
        )
        cell_area = (2 * self.focus_radius / POSITION_CELLS) ** 2
        offset = p - self.center
        offset -= towards * dr.dot(offset, towards)
        on_disk = dr.squared_norm(offset) <= self.radius**2
        density = guided * probability / cell_area
        if self.portals is not None:
            entering = self._entering_share(towards, row, active)
            density += entering * self.portals.density(towards, p, active)
            guided += entering
        return density + dr.select(on_disk, (1 - guided) / (dr.pi * self.radius**2), 0)

    def _entering_share(self, towards, row, active):
        """Share of the sub-paths of a row that start where faces are lit; none where these look
        away."""
        return dr.select(
            self.portals.lit(towards), dr.gather(mi.Float, self._entering, row, active), 0
        )

    def sample_position(self, towards, row, sample, jitter, extra, active):
        """Origin of a sub-path that travels against `towards`, and its density per unit area.

        `extra` chooses among the histogram, the faces of the box and the plain disk; `jitter` (a
        second pair of uniform numbers, or None) places the origin inside its cell, else `sample`'s
        own leftover digits do.
        """
        s, t = _across(towards)
        guided = dr.gather(mi.Float, self._guided, row, active)
        use_grid = extra < guided
        cells = POSITION_CELLS**2
        cell, leftover = draw_cell(self._cdf, row * cells, cells, sample.x, active)
        u, v = in_square_cell(
            cell, mi.Point2f(leftover, sample.y) if jitter is None else jitter, POSITION_CELLS
        )
        on_grid = self.focus_center + self.focus_radius * ((2 * u - 1) * s + (2 * v - 1) * t)
        disk = mi.warp.square_to_uniform_disk_concentric(sample)
        on_disk = self.center + self.radius * (disk.x * s + disk.y * t)
        if self.portals is not None:
            enters = ~use_grid & (extra < guided + self._entering_share(towards, row, active))
            on_disk = dr.select(
                enters, self.portals.sample(towards, sample, jitter, active & enters), on_disk
            )
        p = dr.select(use_grid, on_grid, on_disk)
        density = self.position_density(towards, row, p, active)
        p += towards * (1.01 * self.radius - dr.dot(p - self.center, towards))
        return p, density

    def sample_direction(self, emitter, index, it, sample, extra, active):
        """Direction towards an environment, its density per solid angle, its table row, and what is
        left of `extra`."""
        first = self.row_of_emitter(index)
        if self.sampler.by_table:
            turned, towards, sample = self.sampler.from_table(sample, active)
        ds, _ = emitter.sample_direction(it, sample, active)
        if self.sampler.by_table:
            ds.d = dr.select(turned, towards, ds.d)
        if self.direction_share < 1:
            own, extra = split(extra, self.direction_share)
            cell, leftover = draw_cell(
                self._direction_cdf, mi.UInt32(0), direction_cells(), sample.x, active
            )
            ds.d = dr.select(own, ds.d, cell_direction(cell, mi.Point2f(leftover, sample.y)))
        if self.direction_share < 1 or self.sampler.by_table:
            own_pdf = emitter.pdf_direction(it, ds, active)
            ds.pdf = self.direction_density(own_pdf, ds.d, active)
        return ds.d, ds.pdf, first + direction_cell(ds.d), extra

    def direction_density(self, own_pdf, towards, active=True):
        """Density per solid angle of `sample_direction`, where the environment's own sampler has
        density `own_pdf`."""
        density = self.sampler.density(own_pdf, towards, active)
        if self.direction_share == 1.0:
            return density
        table_pdf = dr.gather(mi.Float, self._direction_pmf, direction_cell(towards), active) * (
            direction_cells() / (4 * dr.pi)
        )
        return self.direction_share * density + (1 - self.direction_share) * table_pdf

    # ------------------------------------------------------------------ direct light

    @property
    def turns(self):
        """Whether next-event estimation of an environment asks others than its own sampler, too."""
        return self.aims or (self.sampler is not None and self.sampler.by_table)

    def turn(self, p, sample, active):
        """The `Turn` of next-event estimation of an environment from `p`, by `sample`, pairs of
        uniform numbers."""
        counted, turned, good = mi.Bool(False), mi.Bool(False), mi.Bool(True)
        towards = mi.Vector3f(0, 0, 1)
        if self.aims:
            counted = active & self.portals.near(p)
            turned, left = split(sample.x, AIMED_SHARE)
            turned &= counted
            sample = mi.Point2f(dr.select(counted, left, sample.x), sample.y)
            towards, good = self.portals.sample_direction(p, sample, turned)
        if self.sampler.by_table:
            counted, others = active, active & ~turned
            by_table, by_radiance, sample = self.sampler.from_table(sample, others)
            towards = dr.select(by_table, by_radiance, towards)
            turned, good = turned | by_table, good | by_table
        return Turn(counted, turned, towards, good, sample)

    def direct_density(self, own_pdf, p, towards, active=True):
        """Density per solid angle of next-event estimation of an environment from `p`, where its
        own sampler has density `own_pdf`."""
        density = self.sampler.density(own_pdf, towards, active)
        return _aimed_density(self.portals, density, p, towards, active) if self.aims else density

    # ------------------------------------------------------------------ power

    def useful_power(self, power):
        """Emitters' powers with those of infinite emitters replaced by the power that passes where
        the pilot saw use."""
        result = np.array(power, dtype=np.float64)
        count = 16384
        rng = streams(dr.arange(mi.UInt32, count), mi.UInt32(0x75736566))
        for index, emitter in self.infinite:
            number = mi.UInt32(index)
            it = point(self.center, mi.Float(0))
            if emitter.is_environment():
                towards, pdf, row, extra = self.sample_direction(
                    emitter, number, it, next_2d(rng), rng.next_float32(), True
                )
                value = radiance(emitter, towards) * dr.select(pdf > 0, dr.rcp(pdf), 0)
            else:
                ds, irradiance = emitter.sample_direction(it, mi.Point2f(0.5))
                towards, value = ds.d + dr.zeros(mi.Vector3f, count), channel_mean(irradiance)
                row, extra = self.row_of_emitter(number), rng.next_float32()
            p, density = self.sample_position(towards, row, next_2d(rng), next_2d(rng), extra, True)
            cell, inside = self._position_cell(towards, p)
            used = inside & (
                dr.gather(mi.Float, self._pmf, row * POSITION_CELLS**2 + cell, inside) > 0
            )
            useful = float(dr.mean(dr.select(used & (density > 0), value / density, 0))[0])
            if np.isfinite(useful) and useful > 0:
                result[index] = useful
        return result
