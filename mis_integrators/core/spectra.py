"""Sums over the channels of a spectrum."""

import drjit as dr


def channel_mean(spectrum):
    """Mean over channels or wavelengths. (`dr.mean` would write the array's width into the kernel,
    to be compiled anew for each width.)"""
    return dr.sum(spectrum) * (1 / dr.size_v(type(spectrum)))
