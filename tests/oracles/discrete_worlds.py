"""Discrete worlds: one pixel whose vertices have finitely many states, so that noise and optimal
weights are known exactly.

K strategies, N_B camera paths, n_F photons per unit of irradiance (light's flux 1). An array of
level j has the shape n1 x ... x nj, the states of z1 ... zj. `measure[j-1]` is the projected solid
angle of z_j seen from z_{j-1} [sr], `f[j-1]` the scattering at z_{j-1} towards z_j [1/sr],
`L0[j-1]` the direct luminance of z_j (0 < j < K-1), `L` and `b` luminance and second photon sum of
level K-1. The camera path draws its direction with p = f / mu, mu the albedo. Weights are a
dictionary: `w[l, i]`, an array of level l - 1. `cost[i]`: what merging a photon at z_i costs in
units of merging it in the disk that n_F is for, an array of level i (a number for i = 0): above one
in smaller disks, and in balls, which find as many photons as a disk of their volume times the
extinction.
"""

from dataclasses import dataclass

from mis_integrators.weights import recursion

import numpy as np


@dataclass
class World:
    K: int
    N_B: float
    n_F: float
    measure: list
    f: list
    L0: list
    L: np.ndarray
    b: np.ndarray
    cost: list | None = None

    def __post_init__(self):
        if self.cost is None:
            self.cost = [np.array(1.0)] + [np.ones(np.shape(a)) for a in self.f]

    def families(self):
        """All (l, i), shortest family first; l = 1 has one strategy, whose weight is one."""
        return [(family, i) for family in range(2, self.K + 1) for i in range(family)]

    def albedo(self, j):
        return np.sum(self.f[j] * self.measure[j], axis=-1)

    def p(self, j):
        """Density of the direction from z_j to z_{j+1}; zero where the vertex is black."""
        mu = self.albedo(j)[..., None]
        return self.f[j] / np.where(mu > 0, mu, 1)

    def c(self):
        """b/L, zero where L is: there the paper has nothing to say."""
        return np.where(self.L > 0, self.b / np.where(self.L > 0, self.L, 1), 0)

    def light(self, family):
        """Luminance that ends the paths of family l: direct at z_{l-1}, or all of it for the last
        one."""
        return self.L if family == self.K else self.L0[family - 2]


def load(entry):
    """The world and the known answers of one entry of optimal_weights.json."""
    names = ("measure", "f", "L0", *(["cost"] if "cost" in entry else []))
    arrays = {name: [np.array(a) for a in entry[name]] for name in names}
    world = World(
        entry["K"],
        entry["N_B"],
        entry["n_F"],
        **arrays,
        L=np.array(entry["L"]),
        b=np.array(entry["b"]),
    )
    weights = {(int(name[1]), int(name[2])): np.array(a) for name, a in entry["weights"].items()}
    return world, weights, entry["J_optimal"], entry["J_single"]


def random_world(seed, K, states=None, n_F=None, N_B=None, spread=1.2, zeros=0.0, mixed=False):
    """`spread`: standard deviation of the logarithms of f and L; `zeros`: share of L0 and L that is
    zero; `mixed`: merging costs differ from vertex to vertex."""
    rng = np.random.default_rng(seed)
    states = states or rng.integers(2, max(2, 7 - K), size=K - 1, endpoint=True)
    shapes = [tuple(states[: j + 1]) for j in range(K - 1)]

    def positive(shape, scale=1.0):
        return scale * np.exp(spread * rng.standard_normal(shape))

    def light(shape):
        return positive(shape, 0.5) * (rng.random(shape) >= zeros)

    f = [positive(s) for s in shapes]
    measure = [rng.uniform(0.2, 1, s) for s in shapes]
    for j in range(K - 1):  # albedos below one
        f[j] *= (rng.uniform(0.2, 0.9, shapes[j][:-1]) / np.sum(f[j] * measure[j], axis=-1))[
            ..., None
        ]
    L = light(shapes[-1])
    return World(
        K,
        int(rng.choice([1, 2, 4, 16])) if N_B is None else N_B,
        10 ** rng.uniform(-1, 2) if n_F is None else n_F,
        measure,
        f,
        [light(s) for s in shapes[:-1]],
        L,
        L * positive(shapes[-1], 0.2),
        [positive(shape) for shape in ((), *shapes)] if mixed else None,
    )


# --- noise, and its minimum by brute force ------------------------------------


def residuals(world, weights):
    """Terms whose sum of squares is the weight-dependent noise J, times N_B (Ershov, Kopylov and
    Voloboy 2021); linear in the weights.

    The merging strategies' kernel costs (1/n_F) w^2 kappa_i rho_l, kappa_0 = N_B f_0, kappa_i = T_i
    f_i, at the last vertex T b/L, each times the vertex's cost; and the camera path's variance, P
    (X - <X>)^2 with X = sum of T_i times what is gathered at z_i, averaged over light paths.
    """
    K, measure, f = world.K, world.measure, world.f
    # per level: T, P, f_0 ... f_j dmu_1 ... dmu_{j+1}
    throughput, chance, flux = [np.array(1.0)], [np.array(1.0)], [np.array(1.0)]
    for j in range(K - 1):
        throughput.append(
            throughput[j][..., None] * world.albedo(j)[..., None] * np.ones_like(f[j])
        )
        chance.append(chance[j][..., None] * world.p(j) * measure[j])
        flux.append(flux[j][..., None] * f[j] * measure[j])

    costs, gathered = [], [np.zeros(np.shape(t)) for t in throughput]
    for family, i in world.families():
        carried = world.light(family) * weights[family, i]
        if i < family - 1 or family == K:
            if i == K - 1:
                kappa = throughput[i] * world.c() * world.cost[i]
            else:
                kappa = world.N_B * f[0] if i == 0 else throughput[i][..., None] * f[i]
                kappa = kappa * world.cost[i][..., None]
                kappa = kappa.reshape(kappa.shape + (1,) * (family - 2 - i))
            cost = np.sqrt(kappa / world.n_F * flux[family - 1] * world.light(family))
            costs.append(cost * weights[family, i])
        for j in range(family - 2, i - 1, -1):
            carried = np.sum(carried * f[j] * measure[j], axis=-1)
        gathered[i] = gathered[i] + carried
    X = np.zeros(())
    for j in range(1, K):  # what is gathered at z0 is the same for all camera paths
        X = X[..., None] + throughput[j] * gathered[j]
    mean = np.sum(chance[-1] * X)
    return np.concatenate([np.ravel(c) for c in [*costs, np.sqrt(chance[-1]) * (X - mean)]])


def noise(world, weights):
    """J: the noise's part that depends on the weights, times N_B."""
    return np.sum(residuals(world, weights) ** 2)


def single(world, k):
    """Weights that gather everything at z_k, or at the last vertex of shorter families."""
    return {
        (family, i): np.full(np.shape(world.light(family)), float(i == min(k, family - 1)))
        for family, i in world.families()
    }


def _unpack(world, x):
    """Weights from the free ones (i > 0); those of i = 0 make each family's sum one."""
    weights, at = {}, 0
    for family in range(2, world.K + 1):
        shape, rest = np.shape(world.light(family)), 1.0
        for i in range(1, family):
            weights[family, i] = x[at : at + np.prod(shape)].reshape(shape)
            at += np.prod(shape)
            rest = rest - weights[family, i]
        weights[family, 0] = rest
    return weights


def free(world):
    """Number of weights that can be chosen freely."""
    return sum((family - 1) * np.size(world.light(family)) for family in range(2, world.K + 1))


def perturbed(world, weights, change):
    """Weights plus an admissible change: free(world) numbers."""
    zero, moved = _unpack(world, np.zeros_like(change)), _unpack(world, change)
    return {key: weights[key] + moved[key] - zero[key] for key in weights}


def brute_force(world):
    """The weights of least noise, by dense least squares over all free weights (least norm where
    nothing depends on a weight)."""
    constant = residuals(world, _unpack(world, np.zeros(free(world))))
    matrix = np.stack(
        [residuals(world, _unpack(world, x)) - constant for x in np.eye(free(world))], axis=1
    )
    size = np.linalg.norm(matrix, axis=0)  # columns of equal size: best conditioning
    size[size == 0] = 1
    x, *_ = np.linalg.lstsq(matrix / size, -constant, rcond=1e-14)
    return _unpack(world, x / size)


# --- the recursion on a world -------------------------------------------------


def on_numpy(function, *arguments):
    return function(*arguments)


def on_drjit(function, *arguments):
    """The same function on flat Dr.Jit arrays of the active variant."""
    import mitsuba as mi

    arrays = np.broadcast_arrays(*arguments)
    return np.array(function(*[mi.Float(np.ravel(a)) for a in arrays])).reshape(arrays[0].shape)


def recurse(world, local=False, dtype=np.float64, call=on_numpy, estimate=lambda x: x):
    """Weights by `recursion`, its integrals as sums over the world's states, each passed through
    `estimate`; and e_1 ... e_{K-1}.

    `local` leaves the integrals out; `call` applies an elementwise function.
    """
    K = world.K
    measure, f, p, L0, cost = (
        [np.asarray(a, dtype) for a in arrays]
        for arrays in (
            world.measure,
            world.f,
            [world.p(j) for j in range(K - 1)],
            world.L0,
            world.cost,
        )
    )
    # What merging costs: BSDF and density of the camera path grow alike.
    dear_f, dear_p = ([x * cost[j][..., None] for j, x in enumerate(of)] for of in (f, p))
    L, c, n, N_B = (np.asarray(a, dtype) for a in (world.L, world.c(), world.n_F, world.N_B))

    def integral(j, x):
        total = np.sum(x * measure[j], axis=-1)
        return estimate(np.zeros_like(total) if local else total)

    def average(j, x):
        return integral(j, x * p[j])

    r, theta, onward = [None, call(recursion.first_ratio, dear_p[0], N_B)], [None], [None]
    for i in range(1, K - 1):
        theta.append(call(recursion.kernel_share, r[i][..., None], dear_f[i]))
        onward.append(call(recursion.kernel_rest, r[i][..., None], dear_f[i]))
        r.append(call(recursion.next_ratio, theta[i], dear_p[i]))

    e, eta, tau, luminance = [None] * K, [None] * K, [None] * K, L
    for i in range(K - 1, 0, -1):
        if i == K - 1:
            gamma = call(recursion.deepest_response, n, L, c * cost[i], r[i])
        else:
            first, second = (average(i, onward[i] ** power * eta[i + 1]) for power in (1, 2))
            tau[i] = (
                np.zeros_like(r[i]) if local else call(recursion.carry, first, average(i, e[i + 1]))
            )
            gamma = call(
                recursion.inner_response,
                n,
                L0[i - 1],
                r[i],
                integral(i, onward[i] / cost[i][..., None] * luminance),
                second,
                first,
                tau[i],
            )
            luminance = L0[i - 1] + integral(i, f[i] * luminance)
        e[i], eta[i] = call(recursion.remainder, gamma), call(recursion.response, gamma)

    offset = (
        np.asarray(0, dtype)
        if local
        else call(recursion.root_offset, average(0, f[0] * eta[1]), average(0, e[1]))
    )
    drive = [None, call(recursion.bounded_drive, call(recursion.first_drive, offset, f[0]), r[1])]
    for i in range(1, K - 1):
        raw = call(
            recursion.next_drive, drive[i][..., None], e[i][..., None], tau[i][..., None], onward[i]
        )
        drive.append(call(recursion.bounded_drive, raw, r[i + 1]))

    weights = {}
    for family in range(2, K + 1):
        last = family - 1
        if family < K:
            w = call(recursion.direct_weight, drive[last], e[last])
        else:
            w = call(recursion.deepest_weight, drive[last], e[last], r[last], c * cost[last])
        weights[family, last] = deeper = w
        for i in range(family - 2, 0, -1):
            at = (...,) + (None,) * (family - 2 - i)
            w = call(
                recursion.inner_weight,
                drive[i][(*at, None)],
                e[i][(*at, None)],
                theta[i][at],
                deeper,
            )
            weights[family, i], deeper = w, deeper + w
        weights[family, 0] = 1 - deeper
    return weights, e[1:]
