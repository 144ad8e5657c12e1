"""Russian roulette: paths end at random, and those that go on stand for those that do not."""

import drjit as dr


def russian_roulette(rng, throughput, strength, eta, begun, active):
    """The rule of Mitsuba's `path`: the active paths that have `begun` to play go on with
    probability min(`strength` `eta`^2, 0.95), and their throughput is divided by it. Paths without
    `strength` end in any case.

    `strength`: how much a path still carries, the largest channel of its throughput, or of its flux
    over that at the start; `eta`: the product of relative indices of refraction on the way, whose
    square undoes the compression of radiance (1 for flux, which boundaries do not compress);
    `begun`: usually depth >= `rr_depth`. Advances `rng` where a path plays. Returns `(throughput,
    active)`.
    """
    active = active & (strength > 0)
    plays = active & begun
    survival = dr.minimum(strength * dr.square(eta), 0.95)
    active = active & (~plays | (rng.next_float32(plays) < survival))
    return dr.select(plays, throughput * dr.rcp(survival), throughput), active
