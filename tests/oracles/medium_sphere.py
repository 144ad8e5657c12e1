"""Noise of two strategies in a closed sphere full of fog, by quadrature: photons merged in balls in
the fog and in disks on the wall.

Light and camera are at the centre, in a smaller empty ball, so that direct light is bounded. The
fog scatters evenly and the wall is Lambertian: a vertex is known by its distance from the centre,
and whether it lies on the wall. A camera path has two vertices, z_0 and z_1, and paths have four
segments at most. Fluxes and radiances are those of one channel.
"""

from dataclasses import dataclass

import numpy as np

DIRECTIONS, STEPS, NODES = 96, 64, 96
"""Of the quadratures: directions from a vertex, places along each of them, and distances from the
centre at which light that has scattered twice is known."""


@dataclass
class MediumSphere:
    """The world: the wall has radius one.

    `inner`: radius of the empty ball; `extinction` [1/m] and `albedo` of the fog; `wall`: albedo of
    the wall; `intensity` of the lamp [W/sr].
    """

    inner: float
    extinction: float
    albedo: float
    wall: float
    intensity: float

    # --- vertices: distance r from the centre, and whether they lie on the wall -------------------

    def scattering(self, on_wall):
        """f, the same for all directions [1/sr]."""
        return np.where(on_wall, self.wall / np.pi, self.albedo / (4 * np.pi))

    def albedos(self, on_wall):
        return np.where(on_wall, self.wall, self.albedo)

    def once(self, r, on_wall):
        """Radiance of a vertex under direct light."""
        left = np.exp(-self.extinction * (r - self.inner))
        return self.scattering(on_wall) * self.intensity * left / r**2

    def first_vertices(self):
        """Where rays from the centre scatter: r, on_wall, probability."""
        return self._along(self.inner, np.array(1.0), False)

    def next_vertices(self, r, on_wall):
        """Where paths go on to from one vertex: arrays r, on_wall, probability."""
        k = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
        cosine = -np.sqrt(k) if on_wall else 2 * k - 1
        far, wall, chance = self._along(r, cosine, on_wall)
        return far.ravel(), wall.ravel(), chance.ravel() / DIRECTIONS

    def _along(self, r, cosine, on_wall):
        """The places along rays that leave the distance r, `cosine` with the direction outwards; of
        each ray the last one is the wall."""
        across = r**2 * (1 - cosine**2)
        to_wall = -r * cosine + np.sqrt(np.maximum(1 - across, 0))
        meets = (cosine < 0) & (across < self.inner**2)
        half = np.where(meets, np.sqrt(np.maximum(self.inner**2 - across, 0)), 0)
        depth = self.extinction * (to_wall - 2 * half)
        scattered = -np.expm1(-depth)
        share = (np.arange(STEPS) + 0.5) / STEPS
        t = -np.log1p(-share * scattered[..., None]) / self.extinction
        before_hole = np.where(meets, -r * cosine - half, np.inf)
        t = t + np.where(t > before_hole[..., None], 2 * half[..., None], 0)
        far = np.sqrt(across[..., None] + (t + (r * cosine)[..., None]) ** 2)
        chance = np.broadcast_to(scattered[..., None] / STEPS, far.shape)
        far = np.concatenate([far, np.ones((*far.shape[:-1], 1))], axis=-1)
        chance = np.concatenate([chance, np.exp(-depth)[..., None]], axis=-1)
        wall = np.zeros(far.shape, bool)
        wall[..., -1] = True
        return far, wall, chance

    # --- light -----------------------------------------------------------------------------------

    def __post_init__(self):
        self.flux = 4 * np.pi * self.intensity
        self.nodes = np.linspace(self.inner, 1, NODES)
        in_fog = np.array([self._twice(r, False) for r in self.nodes])
        self.in_fog, self.at_wall = in_fog.T, self._twice(1.0, True)

    def _twice(self, r, on_wall):
        """Radiance by light that has scattered twice, and the same times the photons' flux."""
        far, wall, chance = self.next_vertices(r, on_wall)
        light = chance * self.albedos(on_wall) * self.once(far, wall)
        return np.sum(light), np.sum(light * self.flux * self.albedos(wall))

    def twice(self, r, on_wall):
        return [
            np.where(on_wall, wall, np.interp(r, self.nodes, fog))
            for fog, wall in zip(self.in_fog, self.at_wall, strict=True)
        ]

    # --- noise -----------------------------------------------------------------------------------

    def kernel(self, on_wall, radius):
        """A: the area of a disk, or of a ball's volume times the extinction."""
        ball = 4 / 3 * np.pi * radius**3 * self.extinction
        return np.where(on_wall, np.pi * radius**2, ball)

    def share_of_photons(self, r, on_wall, radius, light_paths):
        """Balance heuristic of direct light's photons and next-event estimation, in fog."""
        found = light_paths * self.kernel(on_wall, radius) / (4 * np.pi * r**2)
        return np.where(on_wall, 0, found / (1 + found))

    def variances(self, radius, light_paths):
        """Variance of an iteration's pixel with one camera path, over its squared mean: merging at
        z_0 alone, at z_1 alone, and the least one that any weights have whose direct light is
        shared with its photons by the balance heuristic.

        By z_0 they add up. With w the weights at z_1 of direct light and of photons, those of paths
        of three and of four segments, the noise is quadratic: a diagonal for the photons, and the
        camera path's w T L, whose square is in the diagonal too and whose mean is taken off.
        """
        r0, wall0, chance0 = self.first_vertices()
        sums, mean, square = np.zeros(3), 0.0, 0.0
        for r, on_wall, chance in zip(r0, wall0, chance0, strict=True):
            noise, total = self._from(float(r), bool(on_wall), radius, light_paths)
            sums += chance * noise
            mean, square = mean + chance * total, square + chance * total**2
        return (sums + square - mean**2) / mean**2

    def _from(self, r, on_wall, radius, light_paths):
        """For one z_0: noise, for the three kinds of weights, and the mean."""
        far, wall, chance = self.next_vertices(r, on_wall)
        throughput, f = self.albedos(on_wall), self.scattering(wall)
        direct = self.once(far, wall)
        second, second_flux = self.twice(far, wall)
        # Of photons at z_0 and at z_1, (paths of three segments, of four).
        photon = 1 / (light_paths * self.kernel(on_wall, radius))
        at_first = photon * self.scattering(on_wall) * throughput * chance * self.albedos(wall)
        at_first = at_first * np.array([direct * self.flux, second_flux])
        photon = 1 / (light_paths * self.kernel(wall, radius))
        shared = self.share_of_photons(far, wall, radius, light_paths)
        at_second = photon * f * throughput**2 * chance
        at_second = at_second * np.array([shared**2 * direct * self.flux, second_flux])
        light = np.array([direct, second]) * throughput
        own = np.sum(chance * light)
        straight = self.once(r, on_wall)
        total = straight + own

        def noise(w, kept=1.0):
            camera = np.sum(w * light, axis=0)
            scatter = np.sum(chance * camera**2) - np.sum(chance * camera) ** 2
            merged = np.sum((1 - w) ** 2 * at_first)
            deeper = w**2 * at_second
            return scatter + merged + kept * np.sum(deeper[0]) + np.sum(deeper[1])

        # Single strategies leave direct light to next-event estimation.
        noises = [noise(np.zeros_like(light), 0.0), noise(np.ones_like(light), 0.0)]
        shared0 = self.share_of_photons(r, on_wall, radius, light_paths)
        photon = self.scattering(on_wall) / (light_paths * self.kernel(on_wall, radius))
        beside = shared0**2 * photon * straight * self.flux
        noises.append(noise(_least(at_first, at_second, light, chance)) + beside)
        return np.array(noises), total


def _least(at_first, at_second, light, chance):
    """The weights w where the gradient of the noise is zero: for each z_1 two of them, which the
    square of the camera path's light couples, and all of them by its mean."""
    matrix = chance * light[:, None] * light[None]
    for i in range(2):
        matrix[i, i] += at_first[i] + at_second[i]
    matrix = np.moveaxis(matrix, -1, 0)

    def solved(right):
        return np.linalg.solve(matrix, np.moveaxis(right, -1, 0)[..., None])[..., 0].T

    mean = chance * light
    plain, moved = solved(at_first), solved(mean)
    return plain + moved * np.sum(mean * plain) / (1 - np.sum(mean * moved))
