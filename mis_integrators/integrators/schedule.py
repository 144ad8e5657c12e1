"""The merge radius of progressive photon mapping: its parameters, and how it shrinks."""

SMALLEST_RADIUS, LARGEST_RADIUS = 1e-15, 1e15
"""Merge radii whose squares, and those of their small parts and multiples, are ordinary numbers of
single precision."""


def read_radius(parameters):
    """The parameters `initial_radius` and `alpha`."""
    return (
        parameters.number(
            "initial_radius",
            0.0,
            lambda r: r == 0 or SMALLEST_RADIUS <= r <= LARGEST_RADIUS,
            f"0 (automatic) or from {SMALLEST_RADIUS:g} to {LARGEST_RADIUS:g}",
        ),
        parameters.number("alpha", 1.0, lambda a: 0 < a <= 1, "in (0, 1]"),
    )


def shrunk(radius, alpha, iteration):
    """R_i, R_i^2 = R_0^2 (i + 1)^(alpha - 1): a schedule of the iteration's index alone."""
    return radius * (iteration + 1) ** (0.5 * (alpha - 1))
