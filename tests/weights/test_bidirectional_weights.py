"""Weights of connections and merges: recursion against all techniques' densities, one by one
(random numbers, no renderer)."""

import itertools

from mis_integrators.weights import bidirectional as theory

import numpy as np
import pytest

PATHS = 200


class RandomPaths:
    """`PATHS` joint paths x_0 ... x_k with random densities at all vertices, and the densities of
    all techniques multiplied out.

    `delta[i]`: x_i scatters by a delta function; its densities are the same from both sides (and
    cancel). `eta`: merging at every smooth vertex, with the density of the two sub-paths that end
    there times eta.
    """

    def __init__(self, segments, delta, seed, eta=0.0, met=True, ratio=0.7):
        rng = np.random.default_rng(seed)

        def draw(*shape):
            return np.exp(rng.normal(0, 1.5, (*shape, PATHS)))

        k = self.k = segments
        self.delta, self.eta, self.ratio = [False, *delta, False], eta, ratio
        self.geometry = draw(k)  # of segment x_i x_{i+1}
        self.to_camera, self.to_light = draw(k + 1), draw(k + 1)
        for i, is_delta in enumerate(self.delta):
            if is_delta:
                self.to_light[i] = self.to_camera[i]
        # of light sub-paths at x_1 over next-event estimation; of camera rays at x_{k-1}
        self.emission, self.lens = (
            draw(),
            draw(),
        )
        self.direct = draw()  # next-event estimation, per projected solid angle at x_1
        self.met = met

    def camera_density(self, i):
        """Area density of x_i from the camera's side; of x_0 over that of next-event estimation."""
        if i == self.k - 1:
            return self.lens
        density = self.to_light[i + 1]
        return density / self.direct if i == 0 else density * self.geometry[i]

    def light_density(self, i):
        """Area density of x_i from the light's side; of x_0 over that of next-event estimation:
        1."""
        return (
            {0: 1, 1: self.emission}.get(i)
            if i < 2
            else self.to_camera[i - 1] * self.geometry[i - 1]
        )

    def densities(self):
        """{technique: density, up to what all share}: ("join", s), ("merge", i). Beyond the
        sensor's point there are no others."""
        k = self.k
        result = {}
        for s in range(k + 1):
            ends = [i for i in (s - 1, s) if 0 <= i <= k]
            if any(self.delta[i] for i in ends) or (s == 0 and not self.met):
                continue
            value = np.prod(
                [self.light_density(i) * np.ones(PATHS) for i in range(s)], axis=0
            ) * np.prod([self.camera_density(i) * np.ones(PATHS) for i in range(s, k)], axis=0)
            result["join", s] = value * (self.ratio if s == k else 1)
        if self.eta:
            for i in range(1, k):
                if not self.delta[i]:
                    # both ends of a merge are made, each from its side
                    result["merge", i] = (
                        self.eta
                        * np.prod(
                            [self.light_density(j) * np.ones(PATHS) for j in range(i + 1)], axis=0
                        )
                        * np.prod(
                            [self.camera_density(j) * np.ones(PATHS) for j in range(i, k)], axis=0
                        )
                    )
        return result

    def light_states(self, beta):
        """(near, far) at x_1 ... x_{k-1} of the light sub-path."""
        near, far = theory.light_start(self.emission, self.direct)
        states = {1: (near, far if self.met else 0 * far)}
        for i in range(1, self.k - 1):
            near, far = states[i]
            if self.delta[i]:
                states[i + 1] = (0 * near, far)
            else:
                a = theory.nearer(near, far, self.to_light[i], beta, self.eta)
                states[i + 1] = (
                    theory.d_vcm_of(self.to_camera[i], self.geometry[i]),
                    theory.d_vc_of(a, self.to_camera[i]),
                )
        return states

    def camera_states(self, beta):
        """(near, far) at x_{k-1} ... x_0 of the camera sub-path; near at x_0 is left out, for it
        has no area density there."""
        states = {self.k - 1: (theory.camera_start(self.lens, self.ratio), np.zeros(PATHS))}
        for i in range(self.k - 1, 0, -1):
            near, far = states[i]
            if self.delta[i]:
                states[i - 1] = (0 * near, far)
            else:
                a = theory.nearer(near, far, self.to_camera[i], beta, self.eta)
                states[i - 1] = (
                    theory.d_vcm_of(self.to_light[i], self.geometry[i - 1]),
                    theory.d_vc_of(a, self.to_light[i]),
                )
        return states

    def weights(self, beta):
        """{technique: weight} by each technique's own formula."""
        k, light, camera, result = self.k, self.light_states(beta), self.camera_states(beta), {}

        def of_light(i, eta):
            return theory.nearer(*light[i], self.to_light[i], beta, eta)

        def of_camera(i, eta):
            return theory.nearer(*camera[i], self.to_camera[i], beta, eta)

        for kind, number in self.densities():
            if kind == "merge":
                result[kind, number] = theory.merge_weight(
                    of_light(number, 0), of_camera(number, 0), self.eta, beta
                )
            elif number == 0:
                share = 0 * self.direct if self.delta[1] else self.direct / self.to_light[1]
                result[kind, 0] = theory.hit_emitter(
                    share, self.direct * self.emission, camera[0][1], beta
                )
            elif number == k:
                result[kind, k] = theory.connection(
                    self.lens / self.ratio, of_light(k - 1, self.eta), 0, 0, beta
                )
            elif number == 1:
                found = self.to_light[1] / self.direct if self.met else 0 * self.direct
                result[kind, 1] = theory.connection(
                    found, 1, self.emission, of_camera(1, self.eta), beta
                )
            else:
                y, z = number - 1, number
                result[kind, number] = theory.connection(
                    self.to_light[z] * self.geometry[y],
                    of_light(y, self.eta),
                    self.to_camera[y] * self.geometry[y],
                    of_camera(z, self.eta),
                    beta,
                )
        return result


CASES = [
    (k, delta) for k in (2, 3, 4, 5) for delta in itertools.product((False, True), repeat=k - 1)
]


@pytest.mark.parametrize("eta", [0.0, 0.3])
@pytest.mark.parametrize("beta", [1, 2, 3.5])
@pytest.mark.parametrize("met", [True, False])
def test_every_technique_against_brute_force(eta, beta, met):
    for seed, (k, delta) in enumerate(CASES):
        paths = RandomPaths(k, delta, seed, eta, met)
        densities, weights = paths.densities(), paths.weights(beta)
        if not densities:
            continue
        total = sum(p**beta for p in densities.values())
        for technique, density in densities.items():
            np.testing.assert_allclose(
                weights[technique],
                density**beta / total,
                rtol=1e-7,
                atol=1e-10,
                err_msg=f"{k} {delta} {technique}",
            )
        np.testing.assert_allclose(sum(weights.values()), 1, rtol=1e-9)


def test_merging_off_is_connecting():
    """As eta vanishes, weights of joins go to those without merging, and those of merges to
    zero."""
    on, off = (
        RandomPaths(4, (False, True, False), 3, 1e-9),
        RandomPaths(4, (False, True, False), 3, 0.0),
    )
    weights, plain = on.weights(1), off.weights(1)
    for technique, weight in weights.items():
        np.testing.assert_allclose(weight, plain.get(technique, 0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("beta", [1, 2, 8])
def test_extremes_in_single_precision(beta):
    """Densities of zero, tiny and huge ones: weights are numbers from 0 to 1, whatever unit of
    length."""
    values = np.array([0, 1e-30, 1e-12, 1, 1e12, 1e30], dtype=np.float32)
    with np.errstate(over="ignore"):
        for a, b, c, d in itertools.product(values, repeat=4):
            near, far = (
                theory.d_vcm_of(a, b),
                theory.d_vc_of(
                    theory.nearer(theory.d_vcm_of(b, c), theory.d_vcm_of(c, d), d, beta), a
                ),
            )
            inner = theory.nearer(near, far, d, beta)
            for weight in (
                theory.connection(a, inner, b, inner, beta),
                theory.hit_emitter(min(a, 1e30), b * np.float32(1e-10), far, beta),
                theory.merge_weight(inner, inner, np.float32(1e-6), beta),
            ):
                assert 0 <= weight <= 1, (a, b, c, d, weight)


@pytest.mark.parametrize("beta", [1, 2, 3])
def test_units(beta):
    """A scene in millimetres has the same weights as in metres."""
    paths = RandomPaths(4, (False, False, False), 9, 0.2)
    before = paths.weights(beta)
    paths.geometry, paths.emission, paths.lens, paths.eta = (
        paths.geometry / 1e6,
        paths.emission / 1e6,
        paths.lens / 1e6,
        paths.eta * 1e6,
    )
    for technique, weight in paths.weights(beta).items():
        np.testing.assert_allclose(weight, before[technique], rtol=1e-9)
