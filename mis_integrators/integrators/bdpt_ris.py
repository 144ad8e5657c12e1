"""Plugins `pcbpt` and `bdpt_ris`: bidirectional path tracing with resampled light sub-paths."""

from __future__ import annotations

from .resampled import ResampledIntegrator


class PCBPT(ResampledIntegrator):
    r"""
    .. _integrator-pcbpt:

    Bidirectional path tracing with probabilistic connections (:monosp:`pcbpt`)
    ---------------------------------------------------------------------------

    .. pluginparameters::

     * - resamples
       - |int|
       - As of :monosp:`bdpt_ris`. (Default: 1)
     * - light_paths, cache_neighbors, target, weights, light_tracing, merging, guided_lights,
         initial_radius, alpha, camera_paths, variance, aovs, max_depth, rr_depth, hide_emitters,
         sampler
       -
       - As of :monosp:`bdpt_ris`.

    The connections of :monosp:`bdpt_ris` (Popov, Ramamoorthi, Durand and Drettakis 2015) under
    weights that know nothing of the resampling: the balance heuristic of the densities with which a
    light sub-path and a camera sub-path make a path. For comparison. The value ``published`` of
    ``weights`` here stands for the pmfs of that form.

    .. tabs::
        .. code-tab:: xml

            <integrator type="pcbpt">
                <integer name="light_paths" value="100"/>
            </integrator>

        .. code-tab:: python

            'type': 'pcbpt',
            'light_paths': 100
    """

    aware = False


class BDPTRIS(ResampledIntegrator):
    r"""
    .. _integrator-bdpt_ris:

    Bidirectional path tracing with resampled light sub-paths (:monosp:`bdpt_ris`)
    ------------------------------------------------------------------------------

    .. pluginparameters::

     * - light_paths
       - |int|
       - Light sub-paths (M) that all camera paths of an iteration share; from 1 to 100000.
         (Default: 200)
     * - resamples
       - |int|
       - Connections (N) of each camera vertex, each to a light vertex drawn anew; from 1 to 1024.
         (Default: 2)
     * - cache_neighbors
       - |int|
       - Cache points whose pmfs a camera vertex mixes (N_c); from 1 to 16. (Default: 3)
     * - target
       - |string|
       - What the pmfs are proportional to: ``f_y_rho_g_v`` is a light vertex's light at the cache
         point, visibility included; ``f_y_f_yz`` also has the BSDF there. (Default:
         ``f_y_rho_g_v``)
     * - weights
       - |string|
       - ``bounded``: pmfs that also hold light which a cache point does not see, and an estimate of
         each connection's weight; weights that count each draw as one to two connections.
         ``published``: pmfs and weights as Nabata et al. have them, without any bound. (Default:
         ``bounded``)
     * - light_tracing
       - |float|
       - Light sub-paths that are joined to the sensor, for each camera path (N_t); from 0.125 to 8.
         0 stands for the default. (Default: 1)
     * - merging
       - |bool|
       - Merges camera vertices with the light sub-paths that end near them, as :monosp:`vcm` does:
         those that are joined to the sensor. Not with ``published`` weights. (Default: no, i.e.
         |false|)
     * - guided_lights
       - |bool|
       - Whether light sub-paths of suns, skies and environment maps start mostly where they light
         what the camera sees, as a pilot of camera paths tells. (Default: yes, i.e. |true|)
     * - initial_radius
       - |float|
       - With ``merging``: merge radius of the first iteration, in scene units; 0 stands for 0.4 %
         of the spread of what the camera sees. (Default: 0)
     * - alpha
       - |float|
       - With ``merging``: radius reduction of progressive photon mapping, in (0, 1]: iteration i
         uses R_i^2 = R_0^2 (i + 1)^(alpha - 1). 1 keeps the radius. (Default: 1)
     * - camera_paths
       - |int|
       - Camera paths per pixel and iteration, which share its light sub-paths and pmfs. (Default:
         4)
     * - variance
       - |bool|
       - Adds the channels ``var.R``, ``var.G``, ``var.B`` (mono: ``var.Y``): the estimated variance
         of the pixel mean over the iterations, of which there must be two at least. (Default: no,
         i.e. |false|)
     * - aovs
       - |string|
       - Adds layers of what the camera sees, ``name:type`` with commas between them, as Mitsuba's
         ``aov``: of the types ``albedo``, ``sh_normal`` (through glass and in mirrors), ``depth``,
         ``position``, ``geo_normal``, ``uv``, ``shape_index``, ``prim_index`` (of the first
         surface); and ``direct``, ``indirect``, ``caustic``, which sum to the image. Channels are
         ``name.R``, ``name.X`` and so on, after all others. (Default: ``none``)
     * - max_depth
       - |int|
       - Longest path in segments (-1: unlimited). A value of 1 shows only directly visible
         emitters, 2 adds direct light, and so on. (Default: -1)
     * - rr_depth
       - |int|
       - Depth from which Russian roulette may end a sub-path, in each half. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no, i.e. |false|)
     * - sampler
       - |string|
       - Random numbers of sub-paths: ``sobol``, scrambled Sobol' sequences, one a pixel over all
         iterations; or ``independent``. The scene's ``<sampler>`` is not used but for its sample
         count. (Default: ``sobol``)

    Each iteration traces light sub-paths and, at cache points strewn over what the camera sees,
    makes the pmf of the light vertices of M of them, with shadow rays. A camera vertex draws the
    light vertices that it connects to from the pmfs of the cache points near it. Light tracing and
    emission that camera paths meet are techniques beside it, and the weights of all know that the
    connections were resampled (Nabata, Iwasaki and Dobashi 2020). Unbiased, but for the bias of
    ``merging``, which vanishes with the radius.

    In participating media vertices are drawn, joined and merged as on surfaces; the value
    ``published`` of ``weights`` is refused there, and so is the phase function ``sggx`` as part of
    another one. The BSDF ``hair``, polarised variants, gradients and the film ``specfilm`` are
    refused by name.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpt_ris">
                <integer name="light_paths" value="400"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpt_ris',
            'light_paths': 400
    """
