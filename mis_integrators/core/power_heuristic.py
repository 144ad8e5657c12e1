"""The power heuristic of two techniques."""

from __future__ import annotations

import drjit as dr


def mis_power(pdf_a, pdf_b):
    """Power heuristic weight (beta = 2) of the strategy with density `pdf_a`; zero where both
    vanish (Veach 1997, eq. 9.13)."""
    ratio = dr.minimum(pdf_b / pdf_a, 1e18)  # in ratios: squared densities overflow
    return dr.select(pdf_a > 0, dr.rcp(1 + dr.square(ratio)), 0)
