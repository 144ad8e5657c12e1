"""Purposes of random seeds: numbers that tell apart what an iteration draws for one thing and for
another. Those of one kind of session differ; other numbers make other images."""

LIGHT, CAMERA, WAVELENGTH = 0, 1, 2
"""Light sub-paths, camera paths, and the wavelengths that all of an iteration share."""
SURFACES = 6
"""Layers of surfaces: of the render, not of an iteration."""

# --- Photon maps ---------------------------------------------------------------------------------

FROZEN, DIRECT, CAUSTIC_RADII, SENSOR = 3, 4, 5, 6
"""Photons that weights are made of, paths that see direct light only, photons that tell the light
around others, and photons that are joined with the sensor."""

# --- Sub-paths that are connected ----------------------------------------------------------------

APERTURE = 3
"""Points of the sensor's lens that light is joined with."""
SHADOWS = 5
"""Shadow rays of `bdpt`, in media."""
START, DRAW = 4, 5
"""Starts of resampled light sub-paths next to the camera's vertices, and which are drawn."""
