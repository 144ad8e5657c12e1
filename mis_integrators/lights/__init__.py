"""Emitters as light sub-paths and direct light need them: sampling, densities, and where the light
of environments enters."""
