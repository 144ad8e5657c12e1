"""Sub-paths, photon maps, and the densities of emitters and sensors: what every integrator shares.

Nothing in here knows a multiple importance sampling weight between integrators' strategies. All functions take the
active Mitsuba variant's types; nothing is bound to a variant at import time.
"""
