"""Errors that the tests must find, one change of one line each: `mutants.py` makes them.

Each is really wrong: it moves a mean, a density, a law or a promise, none is the same program in
other words. `tests` are what should find it, as pytest takes them.
"""

from __future__ import annotations

from typing import NamedTuple


class Mutation(NamedTuple):
    """A text of a file of `mis_integrators` (there once), what takes its place, and what that
    breaks."""

    file: str
    text: str
    replacement: str
    breaks: str
    tests: str

    @property
    def name(self) -> str:
        """What the commands call it: the file and what breaks."""
        return f"{self.file}: {self.breaks}"


VECTORS = "tests/test_vectors.py"
WEIGHTS = "tests/weights/test_bidirectional_weights.py"
RESAMPLING = "tests/weights/test_resampling.py"
SEQUENCES = "tests/core/test_sequences.py"
TRANSPORT = "tests/paths/test_transport.py"
RADIUS = "tests/pilot/test_radius.py"
PATHS = "tests/pilot/test_paths_per_pixel.py"
LIGHT_SHARE = "tests/pilot/test_light_share.py"
CACHE = "tests/resampling/test_cache_points.py"
DENOISING = "tests/app/test_denoising.py"
SHIFTS = "tests/volume/test_shifts.py"
VIEWS = "tests/volume/test_multiview.py"
BDPM = "tests/integrators/test_bdpm.py"
AUTO = "tests/integrators/test_auto.py"
BDPT = "tests/integrators/test_bdpt.py"
FOG = "tests/integrators/test_bdpt_media.py"
RIS_FOG = "tests/integrators/test_bdpt_ris_media.py"
RIS = "tests/integrators/test_bdpt_ris.py"
BALANCE = "tests/integrators/test_balance.py"
BALANCE_MEDIA = "tests/integrators/test_balance_media.py"
MEDIA = "tests/integrators/test_bdpm_media.py"
BEAMS = "tests/photons/test_beams.py"
OPTIMAL = "tests/integrators/test_weights_in_renders.py"
ANALYTIC = "tests/integrators/test_analytic.py"
LONG = "tests/app/test_long_renders.py"
TIERS = "tests/photons/test_tiers.py"
PIXEL_DISKS = "tests/integrators/test_pixel_disks.py"
CHANCE = "tests/integrators/test_chance.py"
SENSOR_LIGHT = "tests/integrators/test_sensor_light.py"
VOLUME_RADII = "tests/photons/test_volume_radii.py"
LOBES = "tests/integrators/test_narrow_lobes.py"
VCM = "tests/integrators/test_vcm.py"
OPT_FOG = "tests/integrators/test_opt_media.py"
RECORDED = "tests/integrators/test_recorded.py"
HIDDEN = "tests/integrators/test_hidden_emitters_in_media.py"

MUTATIONS = [
    # ------------------------------------------------------------------ weights
    Mutation(
        "weights/bidirectional.py",
        "return d_vcm, at_most(d_vcm * reciprocal(direct), LARGEST_RATIO)",
        "return d_vcm, at_most(d_vcm * direct, LARGEST_RATIO)",
        "a density in place of its inverse where light sub-paths start",
        WEIGHTS,
    ),
    Mutation(
        "weights/heuristics.py",
        "return bounded_power(ratio, beta) * (1 + total)",
        "return bounded_power(ratio, beta) * 1 + total",
        "running sums forget to multiply what came before",
        VECTORS,
    ),
    Mutation(
        "weights/recursion.py",
        "return u + tau * u / at_least(rest, SMALLEST_DENOMINATOR)",
        "return u + tau * u",
        "the drive of the next vertex without its division",
        VECTORS,
    ),
    Mutation(
        "weights/resampling.py",
        "return integrate(conditional / p_camera)",
        "return integrate(conditional)",
        "the variance over camera paths forgets how likely each of them is",
        RESAMPLING,
    ),
    Mutation(
        "weights/resampling.py",
        "x = at_most(ratio, LARGEST_RATIO) * (N / M)",
        "x = at_most(ratio, LARGEST_RATIO) / M",
        "several draws count as one",
        RESAMPLING,
    ),
    # ------------------------------------------------------------------ mis
    Mutation(
        "mis/optimal.py",
        "dr.select(node.last, final, here + deeper), direct)",
        "dr.select(node.last, final, here), direct)",
        "weights of deeper strategies are left out of the first one's rest",
        f"{OPTIMAL}::test_weights_of_a_path_sum_to_one",
    ),
    Mutation(
        "mis/heuristic.py",
        "after = add_ratio(deeper, ratio(p, q), self.beta)",
        "after = add_ratio(deeper, ratio(q, p), self.beta)",
        "a ratio of densities upside down",
        f"{BALANCE}::test_weights_of_a_path_sum_to_one",
    ),
    Mutation(
        "mis/vertex_merging.py",
        "theory.connection(connection.density * (1 / self.ratio), a_light",
        "theory.connection(connection.density, a_light",
        "joining to the sensor forgets how many light sub-paths there are",
        f"{BDPT}::test_weights_sum_to_one",
    ),
    Mutation(
        "mis/step_sums.py",
        "            here += eta",
        "            here += 0 * eta",
        "weights forget merges nearer to the camera",
        f"{RIS}::test_weights_sum_to_one",
    ),
    Mutation(
        "photons/vertex_map.py",
        '    keep = active & in_medium(y["n"])',
        "    keep = active",
        "vertices on surfaces are merged in media, too",
        f"{VCM}::test_fog_that_only_merging_lights",
    ),
    Mutation(
        "photons/points.py",
        "value = flux * scattering.value / points.scattering_around(landing.p, hit)",
        "value = flux * scattering.value",
        "light in balls is not divided by how densely photons are left",
        f"{OPT_FOG}::test_a_ball_finds_what_brute_force_finds",
    ),
    Mutation(
        "mis/optimal.py",
        "return f, dr.select(inside, phase_pdf * scale, p)",
        "return f, dr.select(inside, phase_pdf, p)",
        "densities in media are not in units of what a ball costs",
        f"{OPT_FOG}::test_weights_of_a_path_sum_to_one",
    ),
    Mutation(
        "mis/optimal.py",
        "found = [self.found_photons(si, bsdf, merged) for _ in found]",
        "found = [self.found_photons(si, bsdf, mask) for _ in found]",
        "direct light gives way to photons that are merged nowhere",
        f"{OPT_FOG}::test_agrees_beyond_the_first_vertex",
    ),
    Mutation(
        "mis/resampling.py",
        "return [dr.select(density > 0, better * theory.reciprocal(density), 0)",
        "return [dr.select(density > 0, theory.reciprocal(density), 0)",
        "light sub-paths' later vertices do not know of the resampling",
        f"{RIS}::test_weights_sum_to_one",
    ),
    Mutation(
        "mis/published_resampling.py",
        "return [*after[:-1], state[2]]",
        "return [*after[:-1], after[2]]",
        "what a light vertex sends to cache points holds its own scattering twice",
        f"{RIS}::test_weights_sum_to_one",
    ),
    Mutation(
        "integrators/resampled.py",
        "before = iteration - 1 if iteration > 0 else PILOT",
        "before = iteration",
        "published weights depend on the light sub-paths that are drawn from",
        f"{RIS}::test_iterations_in_any_order",
    ),
    Mutation(
        "integrators/resampled_passes.py",
        'return self.grid.row(z["p"], z["n"] if self.integrator.published else seen_normal(z))',
        'return self.grid.row(z["p"], seen_normal(z))',
        "published weights ask other cache points than those that draw",
        f"{RIS}::test_weights_sum_to_one",
    ),
    Mutation(
        "integrators/resampled_passes.py",
        "taken = dr.maximum(chance * probability, 1e-20)",
        "taken = dr.maximum(probability, 1e-20)",
        "a draw forgets that its cache point was one of several",
        f"{RIS}::test_point_in_sphere",
    ),
    Mutation(
        "integrators/resampled_passes.py",
        "carried *= seen",
        "pass",
        "media take nothing of what is drawn",
        f"{RIS_FOG}::test_single_scattering_in_closed_form",
    ),
    # ------------------------------------------------------------------ paths
    Mutation(
        "paths/camera_vertices.py",
        "return crossed(before, after, crosses)",
        "return after",
        "steps of camera paths end at half transparent surfaces that they pass",
        f"{RIS_FOG}::test_half_transparent_surfaces",
    ),
    Mutation(
        "paths/roulette.py",
        "return dr.select(plays, throughput * dr.rcp(survival), throughput), active",
        "return throughput, active",
        "paths that go on do not stand for those that end",
        f"{ANALYTIC}::test_roulette_in_sphere",
    ),
    Mutation(
        "paths/light.py",
        "return bs, delta, weight * adjoint, wo, active",
        "return bs, delta, weight, wo, active",
        "no adjoint factor of shading normals",
        f"{BDPT}::test_shading_normals_seen_from_the_light",
    ),
    Mutation(
        "paths/connect.py",
        "* (leaving * dr.rcp(landing * squared))",
        "* (leaving * dr.rcp(squared))",
        "joined vertices keep the cosine with which light landed",
        f"{BDPT}::test_each_technique_in_a_sphere",
    ),
    Mutation(
        "paths/camera.py",
        "active &= depth < max_depth",
        "active &= depth <= max_depth",
        "camera paths go one segment too far",
        f"{ANALYTIC}::test_point_in_sphere",
    ),
    # ------------------------------------------------------------------ lights
    Mutation(
        "lights/kinds.py",
        "return dr.rcp(4 * dr.pi * dr.square(ds.dist))",
        "return dr.rcp(2 * dr.pi * dr.square(ds.dist))",
        "a point light is taken to shine into half of all directions",
        f"{BALANCE}::test_emission_ratio",
    ),
    Mutation(
        "lights/lights.py",
        "flux *= dr.rcp(probability)",
        "flux *= self.choice.count",
        "light sub-paths are weighted as if emitters were chosen evenly",
        f"{TRANSPORT}::test_power_decides_among_emitters "
        f"{ANALYTIC}::test_many_emitters_at_one_place",
    ),
    Mutation(
        "lights/nearby.py",
        "return index, dr.gather(mi.Float, self._pmf, first + index)",
        "return index, dr.gather(mi.Float, self._pmf, index)",
        "emitters are drawn with one cell's probabilities and weighted with another's",
        "tests/lights/test_nearby.py",
    ),
    Mutation(
        "lights/environment_guide.py",
        "mixed = (1 - AIMED_SHARE) * own_pdf + AIMED_SHARE * portals",
        "mixed = own_pdf + AIMED_SHARE * portals",
        "the density of direct light from windows is more than one in all",
        f"{TRANSPORT}::test_densities_of_direct_light_at_windows_are_one_in_all",
    ),
    Mutation(
        "paths/lobes.py",
        "dr.abs(si.wi.z) * len(COSINES) - 0.5",
        "dr.abs(si.wi.z) * len(COSINES) + 0.5",
        "lobes are narrow from other angles than those they were looked at",
        LOBES,
    ),
    Mutation(
        "photons/queries.py",
        "passed = at.narrow & ~at.ends",
        "passed = mi.Bool(False)",
        "paths end behind narrow lobes that they pass",
        LOBES,
    ),
    Mutation(
        "paths/lobes.py",
        "concentration(rest_of(lobed.looks, lobed.parted)) > NARROW",
        "concentration(lobed.looks) > NARROW",
        "a coat on a bright ground does not count as narrow",
        LOBES,
    ),
    Mutation(
        "integrators/bdpm.py",
        "            and not integrator.initial_radius\n            and self.traits.has_light",
        "            and self.cones is not None\n            and self.traits.has_light",
        "in raw renders photons alone bring caustic light",
        "tests/integrators/test_chance.py::test_who_shares",
    ),
    # ------------------------------------------------------------------ photons
    Mutation(
        "photons/gather.py",
        "hit &= landing.depth + vertices.depth <= max_depth",
        "hit &= landing.depth + vertices.depth < max_depth",
        "merged paths end one segment too early",
        f"{ANALYTIC}::test_point_in_sphere",
    ),
    Mutation(
        "photons/gather.py",
        "return (alike > 0) & (dr.square(alike)",
        "return (alike == alike) & (dr.square(alike)",
        "sheets back to back share their photons",
        "tests/photons/test_curvature.py::test_the_back_of_a_thin_sheet_is_another_surface",
    ),
    Mutation(
        "photons/grid.py",
        "self.reach = radius * inverse * 1.0001",
        "self.reach = radius * inverse * 0.9",
        "photons in the outermost cells of a query are missed",
        f"{TRANSPORT}::test_map_finds_what_brute_force_finds",
    ),
    Mutation(
        "photons/coverage.py",
        "& within_disk(place, dr.squared_norm(place), normal, radius * SLACK)",
        "& within_disk(place, dr.squared_norm(place), normal, radius * SLACK, 2 * radius)",
        "surfaces far below a disk count as covering it",
        "tests/photons",
    ),
    Mutation(
        "photons/coverage.py",
        "place += normal * dr.dot(offset - place, normal)",
        "place = offset",
        "steps down, whose photons count, are taken for edges",
        "tests/photons/test_coverage.py",
    ),
    Mutation(
        "photons/grid.py",
        " & (mi.UInt32(y) < grid.lines)",
        "",
        "wide disks at the edge of a flat scene count photons twice",
        TIERS,
    ),
    Mutation(
        "paths/ray_cones.py",
        "refracted = (spread + turned) * inverse - turned",
        "refracted = (spread + turned) * inverse",
        "a boundary of glass bends cones as if it was flat behind",
        f"{PIXEL_DISKS}::test_cones_meet_in_the_focus",
    ),
    Mutation(
        "paths/ray_cones.py",
        "width = dr.minimum(dr.sqrt(dr.abs(across * along)), plain)",
        "width = plain",
        "pixels behind a magnifying glass share the photons of narrow disks",
        f"{PIXEL_DISKS}::test_pixels_behind_a_magnifying_glass_are_narrow",
    ),
    Mutation(
        "photons/tiers.py",
        "disk = disk_of(number, radius, first, vertices.lobe_width)",
        "disk = radius",
        "well lit photons that the camera sees have no disks of a pixel's size",
        TIERS,
    ),
    Mutation(
        "photons/tiers.py",
        "return photon_map, tier_radius(radius, number), count",
        "return photon_map, radius, count",
        "photons of all tiers have the radius of the first",
        TIERS,
    ),
    Mutation(
        "photons/light_cells.py",
        "dr.select(found == fingerprint, light, 0)",
        "light",
        "the light of other cells counts as light around",
        TIERS,
    ),
    Mutation(
        "photons/volume_radii.py",
        "dr.sqrt(self.median / there)",
        "dr.sqrt(there / self.median)",
        "photons that lie densely have the larger radii",
        VOLUME_RADII,
    ),
    Mutation(
        "photons/beams.py",
        "sums.add(totals, value / share, inside",
        "sums.add(totals, value, inside",
        "photons of small disks bring too little light",
        VOLUME_RADII,
    ),
    # ------------------------------------------------------------------ pilot
    Mutation(
        "pilot/noise.py",
        "return self.floor + self.photons / light_share",
        "return self.floor + self.photons * light_share",
        "fewer photons make less noise",
        LIGHT_SHARE,
    ),
    Mutation(
        "pilot/bias.py",
        "(m * (m - 1))",
        "(m * m)",
        "products of iterations are biased",
        RADIUS,
    ),
    Mutation(
        "pilot/radius.py",
        "return self.squared_bias + variance / iterations",
        "return self.squared_bias + variance",
        "the radius does not know how long a render will be",
        RADIUS,
    ),
    Mutation(
        "pilot/noise.py",
        "return floor + np.maximum.accumulate(photons[::-1])[::-1] / radii**2",
        "return floor + photons / radii**2",
        "small disks are believed to be without noise",
        RADIUS,
    ),
    Mutation(
        "pilot/direct_paths.py",
        "paths = np.clip(wanted ** (1 / (1 + exponent)), 1, MOST_PATHS)",
        "paths = np.clip(wanted ** (1 / exponent), 1, MOST_PATHS)",
        "noisy pixels send too many paths",
        PATHS,
    ),
    Mutation(
        "weights/multiview.py",
        "return at_most(ratio, LARGEST_SUMMAND ** (1 / exponent)) ** exponent",
        "return at_most(ratio, LARGEST_SUMMAND ** (1 / exponent)) ** 2.0",
        "the power heuristic of views has one exponent, whatever is asked for",
        "tests/volume/test_view_weights.py",
    ),
    Mutation(
        "volume/views.py",
        "density, d = dr.select(parallel, even, density), dr.select(parallel, -forward, d)",
        "d = dr.select(parallel, -forward, d)",
        "paths of orthographic views have the density of perspective ones",
        f"{VIEWS}::test_orthographic_views",
    ),
    Mutation(
        "volume/shifts.py",
        "at, majorant = at_length(target, C * length(base, t))",
        "at, majorant = at_optical_depth(target, C * length(base, t))",
        "raw depth is measured in optical depths on the target",
        f"{VIEWS}::test_three_media",
    ),
    # ------------------------------------------------------------------ resampling
    Mutation(
        "resampling/cache_targets.py",
        "dr.ReduceOp.Add, Q_s, r * (1 / M),",
        "dr.ReduceOp.Add, Q_s, r,",
        "Q is a sum over light sub-paths and not their mean",
        f"{RIS}::test_integrals_in_a_sphere",
    ),
    Mutation(
        "resampling/cache_targets.py",
        'return dr.select(unblocked(self.scene, z["p"], z["n"], d, distance, active), r, 0)',
        "return dr.select(active, r, 0)",
        "weights leave out what stands between a cache point and a light vertex",
        f"{RIS}::test_weights_sum_to_one",
    ),
    Mutation(
        "resampling/cache_pmfs.py",
        "drawn = ~real | (dr.gather(mi.Float, self.totals, point, real) > 0)",
        "drawn = ~real | (dr.gather(mi.Float, self.totals, point, real) >= 0)",
        "cache points without light draw a light vertex all the same",
        CACHE,
    ),
    Mutation(
        "resampling/proposals.py",
        "mean += (1 - share) * dr.maximum(upper - lower, 0)",
        "mean += dr.maximum(upper - lower, 0)",
        "probabilities of draws sum to more than one",
        f"{CACHE}::test_draws_have_their_probability",
    ),
    Mutation(
        "resampling/light_vertices.py",
        'leaving * (y["d_vcm"] + back * y["d_vc"] + self.eta_at(y)),',
        'leaving * (y["d_vcm"] + self.eta_at(y)),',
        "techniques farther along the light sub-path are left out of the weights",
        f"{RIS}::test_weights_sum_to_one "
        f"{RIS}::test_guessed_weight_is_the_weight_where_nothing_is_guessed",
    ),
    Mutation(
        "resampling/light_vertices.py",
        "+ dr.gather(mi.UInt32, lengths, last) - before",
        "- before",
        "the last light sub-path's vertices are never drawn",
        f"{RIS}::test_point_in_sphere {RIS}::test_one_dominant_sub_path",
    ),
    Mutation(
        "resampling/cache_points.py",
        "return 2 * axis + dr.select(component < 0, mi.UInt32(1), mi.UInt32(0))",
        "return 2 * axis",
        "both sides of a wall share their cache points",
        CACHE,
    ),
    # ------------------------------------------------------------------ volume
    Mutation(
        "volume/shifts.py",
        "_log(C) + 0 * tau,",
        "0 * tau,",
        "a stretch by majorant optical depth without its derivative",
        SHIFTS,
    ),
    Mutation(
        "paths/media.py",
        "value[faint] = dr.select(survives, 2 * value, 0)",
        "value[faint] = dr.select(survives, value, 0)",
        "roulette on the way to a light loses half of what is faint",
        f"{VIEWS}::test_transmittance {VIEWS}::test_little_light",
    ),
    Mutation(
        "volume/suffixes.py",
        "dr.select(on_delta_light, 1, mis_power(light_pdf, light_scatter_pdf))",
        "dr.select(on_delta_light, 1, mis_power(light_scatter_pdf, light_pdf))",
        "the two ways to a light have each other's weights",
        f"{VIEWS}::test_one_view_is_volpath",
    ),
    Mutation(
        "volume/lines.py",
        "density = dr.select(on_surface, density * dr.abs(dr.dot(surface.n, d)), density)",
        "density = dr.select(on_surface, density, density)",
        "views share surfaces without the cosine at which they see them",
        f"{VIEWS}::test_views_on_both_sides_of_a_surface {VIEWS}::test_surfaces",
    ),
    # ------------------------------------------------------------------ photons in media
    Mutation(
        "photons/queries.py",
        'unseen = state["met"] | at.scatters if self.flies else state["met"]',
        'unseen = state["met"]',
        "direct light in media counts as if the paths for direct light saw it",
        f"{MEDIA}::test_agrees_with_volpath",
    ),
    Mutation(
        "photons/beams.py",
        "even = active & long & medium.is_homogeneous()",
        "even = active & medium.is_homogeneous()",
        "short beams lose light that their length has lost before",
        f"{BEAMS}::test_short_beams_take_caustic_photons_only",
    ),
    Mutation(
        "photons/trace.py",
        '"caustic": at.had_delta & ~at.scattered,',
        '"caustic": at.had_delta,',
        "light that has scattered before counts as caustic, too",
        f"{MEDIA}::test_classes_of_light_are_those_of_bdpt",
    ),
    Mutation(
        "mis/heuristic.py",
        "return dr.select(in_medium(n), density * dr.rcp(self.volume_share), value)",
        "return dr.select(in_medium(n), density, value)",
        "merge disks in media have the area of those on surfaces",
        f"{BALANCE_MEDIA}::test_weights_are_veachs",
    ),
    Mutation(
        "mis/heuristic.py",
        "before = dr.select(in_medium(ref.n), 1 + before, before)",
        "pass",
        "next-event estimation in media forgets the photons of the same light",
        f"{BALANCE_MEDIA}::test_weights_of_a_path_sum_to_one",
    ),
    # ------------------------------------------------------------------ core
    Mutation(
        "core/sequences.py",
        "hash_bits(index + ALONE)",
        "hash_bits(self.first + ALONE)",
        "independent numbers of a group are stratified",
        f"{SEQUENCES}::test_independent_numbers",
    ),
    Mutation(
        "core/sequences.py",
        "(2, 0x33333333),",
        "(2, 0x0F0F0F0F),",
        "the second coordinate of the sequences is no Sobol' coordinate",
        SEQUENCES,
    ),
    Mutation(
        "core/packing.py",
        "return (word >> (2 * _SURFACE_NORMAL_BITS)) & MAX_DEPTH",
        "return (word >> (2 * _SURFACE_NORMAL_BITS)) & (MAX_DEPTH >> 1)",
        "depths from 256 on are read back too small",
        f"{TRANSPORT}::test_surface_round_trip",
    ),
    Mutation(
        "core/stratified_variance.py",
        "return sum(counts.values()) - 2 * pairs / half",
        "return sum(counts.values()) - pairs / half",
        "the law of stratified variance counts covariances once",
        "tests/core/test_stratified_variance.py",
    ),
    Mutation(
        "core/film.py",
        'return sums["square"] - 2 * mean * sums["cross"] + mean',
        'return sums["square"] - mean * sums["cross"] + mean',
        "the variance of a weighted mean forgets half of the covariance",
        f"tests/core/test_variance_of_renders.py {BDPM}::test_variance_is_that_of_the_mean",
    ),
    # ------------------------------------------------------------------ app
    Mutation(
        "app/denoising.py",
        '"clean_aux": bool(guides) and all_edges',
        '"clean_aux": False',
        "the denoiser takes the guides' edges for noise",
        f"{DENOISING}::test_edges_that_guides_have_stay_and_the_rest_is_smoother",
    ),
    Mutation(
        "app/denoising.py",
        "weight = np.maximum(1 - DOUBT * variance",
        "weight = np.maximum(1 - variance",
        "rare bright samples come back into denoised images",
        f"{DENOISING}::test_rare_bright_samples_do_not_come_back",
    ),
    Mutation(
        "app/denoising.py",
        "variance = np.maximum(variance, window_mean(variance, AROUND))",
        "pass",
        "denoised images are dark where all bright samples missed",
        f"{DENOISING}::test_windows_that_bright_samples_missed_are_not_dark",
    ),
    Mutation(
        "app/denoising.py",
        "apart = mean_without_largest(",
        "apart = window_mean(",
        "one bright pixel makes a square",
        f"{DENOISING}::test_one_bright_pixel_does_not_make_a_square",
    ),
    Mutation(
        "pilot/direct_paths.py",
        "nearest = (np.arange(height) // step)[:, None] * len(columns)",
        "nearest = (np.arange(height) // step)[:, None] * width",
        "pixels of large films take the noise of others",
        f"{PATHS}::test_large_films_have_trials_in_some_pixels",
    ),
    Mutation(
        "app/checkpoint.py",
        "if hashlib.sha256(body).digest() != digest:",
        "if len(digest) != _DIGEST_BYTES:",
        "a damaged checkpoint is not found out",
        f"{LONG}::test_damage_is_found",
    ),
    Mutation(
        "app/target_error.py",
        "(np.square(mean) + level**2)",
        "(np.square(mean) + level)",
        "the relative error hangs on the unit of light",
        f"{LONG}::test_relative_error_of_known_noise",
    ),
    Mutation(
        "app/fingerprint.py",
        'for pattern in ("*.py", "*.json")',
        'for pattern in ("*.py",)',
        "tables that change do not make another render",
        "tests/app/test_faults.py::test_fingerprint_is_of_every_source",
    ),
    Mutation(
        "app/render_loop.py",
        "if self.requested or not self.have_result:",
        "if not self.have_result:",
        "a second interrupt does not stop at once",
        "tests/app/test_cli.py::test_second_interrupt_stops_at_once",
    ),
    Mutation(
        "integrators/common.py",
        "    @under_render_lock\n    def session(",
        "    def session(",
        "renders are set up while another thread renders",
        "tests/integrators/test_hard_use.py::test_threads_take_turns",
    ),
    Mutation(
        "photons/irradiance_cache.py",
        "        if not self.traits.has_media:\n            return dr.select(active & ~scene",
        "        if True:\n            return dr.select(active & ~scene",
        "boundaries of media block light where its noise is measured",
        "tests/integrators/test_opt_media.py::test_least_noise_in_a_sphere_full_of_fog",
    ),
    Mutation(
        "pilot/radius.py",
        "for each in errors], axis=0)",
        "for each in errors[:1]], axis=0)",
        "radii are chosen by relative error alone",
        "tests/pilot/test_radius.py::test_bright_spots_count",
    ),
    Mutation(
        "photons/queries.py",
        'return PIXEL_DISK * record["pixel"]',
        'return 8 * PIXEL_DISK * record["pixel"]',
        "near pixels share the photons of a caustic that a denoiser sees",
        f"{PIXEL_DISKS}::test_near_pixels_share_no_noise",
    ),
    Mutation(
        "photons/queries.py",
        'return (record["pixel"] > 0) == (kind == "seen_caustic")',
        "return mi.Bool(True)",
        "caustics that the camera sees count twice",
        f"{PIXEL_DISKS}::test_light_counts_once",
    ),
    Mutation(
        "paths/ray_cones.py",
        "return cosine * dr.sqrt(cosine)",
        "return mi.Float(1)",
        "pixels at the border of the film are taken to be as wide as those in its middle",
        f"{PIXEL_DISKS}::test_cones_are_as_wide_as_pixels",
    ),
    Mutation(
        "integrators/pilot_passes.py",
        "pixel += index * pixels.groups // pixels.camera_paths * pixels.apart",
        "pass",
        "the pilot takes noise within a pixel for noise that near pixels share",
        f"{PIXEL_DISKS}::test_groups_of_a_pilot_look_through_near_pixels",
    ),
    Mutation(
        "photons/tiers.py",
        "return dr.select(number > left, number, 0)",
        "return number",
        "photons that a denoiser is to smooth have wide disks",
        f"{TIERS}::test_tiers_bring_what_brute_force_finds",
    ),
    Mutation(
        "photons/sensor_light.py",
        "    active &= ~zone.holds(landing.p)\n",
        "",
        "photons close to the sensor are joined with it, and gathered along beams, too",
        f"{SENSOR_LIGHT}::test_photons_close_to_the_sensor_are_no_dots",
    ),
    Mutation(
        "photons/queries.py",
        "            wanted |= vertex == 0\n",
        "",
        "media seen through glass bring no light where photons are joined with the sensor",
        f"{SENSOR_LIGHT}::test_agrees_with_volpath",
    ),
    Mutation(
        "photons/queries.py",
        "brought / BEAMS_KEPT, 0)",
        "brought, 0)",
        "beams that are kept do not count for those that are not",
        f"{SENSOR_LIGHT}::test_agrees_with_volpath",
    ),
    Mutation(
        "pilot/result.py",
        "+ self.joined[measure] / share",
        "+ self.joined[measure]",
        "fewer light sub-paths make no noise of joined photons",
        f"{SENSOR_LIGHT}::test_the_pilot_counts_little_of_their_noise",
    ),
    Mutation(
        "integrators/pilot_passes.py",
        "return np.array(light)[first + group * pixels.apart]",
        "return np.array(light)[first + group * 0]",
        "the pilot takes the noise of joined photons for noise that near pixels share",
        f"{SENSOR_LIGHT}::test_the_pilot_counts_little_of_their_noise",
    ),
    Mutation(
        "photons/near_zone.py",
        "left = self.depth + self.radius - self",
        "left = self.depth - 2 * self.radius - self",
        "beams end before the zone does",
        f"{SENSOR_LIGHT}::test_beams_reach_to_the_end_of_the_zone",
    ),
    Mutation(
        "mis/chance.py",
        "return weight(0, bounded_power(x, 1))",
        "return weight(0, bounded_power(2 * x, 1))",
        "photons and lights that are met share caustic light unevenly",
        CHANCE,
    ),
    Mutation(
        "photons/hits.py",
        "return density * cosine * dr.rcp",
        "return density * dr.rcp",
        "weights of lights that are met forget the cosine",
        CHANCE,
    ),
    Mutation(
        "lights/lights.py",
        "return dr.select(met, density, NEVER_MET)",
        "return dr.select(met, density, 0)",
        "photons of lights that no ray meets count nothing",
        CHANCE,
    ),
    Mutation(
        "photons/queries.py",
        "unfinished |= mi.has_flag(at.bsdf.flags(), mi.BSDFFlags.Delta)",
        "pass",
        "paths meet no lights behind glass after their last vertex",
        CHANCE,
    ),
    Mutation(
        "paths/media.py",
        "crosses |= met & lamp & unseen",
        "pass",
        "hidden lamps stop camera paths in fog",
        HIDDEN,
    ),
    Mutation(
        "paths/media.py",
        "stands &= ~surface.shape.is_emitter()",
        "pass",
        "hidden lamps stop light in fog on its way to the sensor",
        HIDDEN,
    ),
    Mutation(
        "paths/connect.py",
        "active &= ~on_emitter(scene",
        "active &= mi.Bool(True) | on_emitter(scene",
        "light that hidden lamps scatter in fog comes to the sensor",
        HIDDEN,
    ),
    Mutation(
        "paths/guides.py",
        "unseen &= passes | ",
        "unseen &= ",
        "denoisers are told of the second of two hidden lamps",
        f"{DENOISING}::test_guides_do_not_show_what_is_hidden",
    ),
    Mutation(
        "paths/media.py",
        "counts = shares_of_channels(mi.Spectrum(1) if throughput is None else throughput)",
        "counts = shares_of_channels(mi.Spectrum(1))",
        "all channels count alike in free flight, whatever a path has of them",
        "tests/paths/test_media.py::test_many_flights_make_no_channel_bright",
    ),
    Mutation(
        "photons/beams.py",
        "begins + ends - 1)",
        "begins)",
        "of two opposite walls one cuts a beam's disk",
        f"{BEAMS}::test_coverage_is_the_share_of_a_disk_between_walls",
    ),
    Mutation(
        "photons/queries.py",
        'selected(active, [at.si.n], state["wall"])',
        'selected(active, [mi.Normal3f(0)], state["wall"])',
        "beams do not know of the wall that a path has left",
        f"{MEDIA}::test_walls_do_not_darken_what_is_dense",
    ),
    Mutation(
        "mis/chance.py",
        "density_ratio(density, 1, scattering.p * scattering.shading)",
        "density_ratio(density, 1, mi.Float(1))",
        "photons tell of paths whose directions all have density one",
        f"{CHANCE}::test_photons_tell_how_noisy_paths_are",
    ),
    Mutation(
        "integrators/piloted.py",
        "from ..core.clock import now",
        "from time import perf_counter as now",
        "compiling counts as rendering where a render is planned",
        "tests/core/test_clock.py",
    ),
    Mutation(
        "integrators/choice.py",
        "max(variance, share * chance)",
        "variance",
        "path is judged by samples that have met no caustics",
        f"{AUTO}::test_paths_find_the_caustics_of_a_sky",
    ),
    Mutation(
        "integrators/choice.py",
        "usual = photons.expected_seconds",
        "usual = 0.05 * photons.expected_seconds",
        "an iteration of photons is taken to cost a twentieth of what it does",
        f"{AUTO}::test_prices_are_what_candidates_take",
    ),
    Mutation(
        "integrators/choice.py",
        "noise_left(path.integrator, path.sensor) / path.camera_paths",
        "1 / path.camera_paths",
        "all noise of path counts where a denoiser leaves little of it",
        "tests/integrators/test_denoised.py::test_of_the_noise_of_path_a_denoiser_leaves_its_share",
    ),
    Mutation(
        "integrators/noise_left.py",
        "return filter_share(sensor.film().rfilter())",
        "return 1.0",
        "all noise of path counts where the film's reconstruction filter leaves little of it",
        f"{AUTO}::test_noise_of_path_is_what_its_renders_have",
    ),
    Mutation(
        "core/stratified_variance.py",
        "power += STEEP_SHARE",
        "power += 2 * STEEP_SHARE",
        "variance is taken to fall for ever as it does between few samples",
        "tests/core/test_stratified_variance.py",
    ),
    Mutation(
        "integrators/unidirectional.py",
        "DIRECT_SEGMENTS = 2",
        "DIRECT_SEGMENTS = 3",
        "under path light of three segments is denoised as direct light",
        f"{DENOISING}::test_path_under_bdpm_auto_keeps_its_direct_light_apart",
    ),
    Mutation(
        "integrators/photon_passes.py",
        'takes |= takes_photons(record, "seen_caustic")',
        "pass",
        "for denoisers nothing tells of the caustics that path meets where the camera sees them",
        f"{CHANCE}::test_photons_tell_how_noisy_paths_are",
    ),
    Mutation(
        "lights/environment_guide.py",
        "from_numpy(mi.UInt32, first_rows)",
        "mi.UInt32(first_rows)",
        "kernels know where NumPy has put the rows of environments",
        f"{RECORDED}::test_no_kernel_depends_on_where_numbers_lie",
    ),
    Mutation(
        "integrators/photon_passes.py",
        "dr.make_opaque(camera_pass.pixel, camera_pass.index, beyond)",
        "dr.make_opaque(camera_pass.pixel, beyond)",
        "pilots compile a kernel for camera paths of their own",
        f"{RECORDED}::test_pilot_and_render_trace_camera_paths_by_one_kernel",
    ),
    Mutation(
        "integrators/unidirectional.py",
        "dr.make_opaque(pixel, index)",
        "pass",
        "trials of path compile a kernel of their own",
        f"{RECORDED}::test_trial_and_render_of_path_have_one_kernel",
    ),
    Mutation(
        "photons/curvature.py",
        "dr.maximum(share, LEAST_LEFT)",
        "1",
        "merge disks are wider than the balls that they touch",
        "tests/photons/test_curvature.py",
    ),
    Mutation(
        "lights/environment_sampler.py",
        "probability * (cells / (4 * dr.pi))",
        "probability * (cells / (2 * dr.pi))",
        "the table of an environment's radiance counts double",
        "tests/lights/test_environment_sampler.py",
    ),
    Mutation(
        "lights/environment_sampler.py",
        "self.by_table = moment * WORTH_A_TABLE > 1",
        "self.by_table = False",
        "wide suns are left to Mitsuba's sampler, which misses them",
        "tests/lights/test_environment_sampler.py",
    ),
    Mutation(
        "app/denoising.py",
        "return np.minimum(clean, np.moveaxis(",
        "return np.maximum(clean, 0 * np.moveaxis(",
        "denoised highlights are brighter than any of their samples",
        f"{DENOISING}::test_highlights_are_no_brighter_than_their_samples",
    ),
    Mutation(
        "lights/environment_guide.py",
        "towards, active) if self.aims else density",
        "towards, active) if self.aims else own_pdf",
        "wide suns are drawn by one density and weighted by another",
        f"{TRANSPORT}::test_density_of_direct_light",
    ),
    Mutation(
        "lights/environment_sampler.py",
        "mi.Point2f(dr.select(active, left, sample.x), sample.y)",
        "mi.Point2f(sample.x, sample.y)",
        "of a table of radiance only a part is drawn",
        "tests/lights/test_environment_sampler.py",
    ),
    Mutation(
        "paths/media.py",
        "return dr.select(of_flakes, reflected, wo), weight",
        "return wo, weight",
        "flakes reflect by another density than they say",
        f"{FOG}::test_each_technique_alone",
    ),
    Mutation(
        "paths/connect.py",
        """value *= vertex_bsdf.adjoint(d, light["towards"], active)""",
        """value *= vertex_bsdf.adjoint(d, d, active)""",
        "light from flakes to the sensor has the phase function of camera paths",
        f"{FOG}::test_each_technique_alone",
    ),
    Mutation(
        "photons/beams.py",
        "return value * adjoint, pdf",
        "return value, pdf",
        "photons in media of flakes scatter as camera paths do",
        "tests/integrators/test_flakes_media.py::test_furnace",
    ),
    Mutation(
        "volume/lines.py",
        "density * projected_area(here, d, within)",
        "density",
        "views share what flakes scatter as if all saw them alike",
        "tests/integrators/test_flakes_media.py::test_views_agree_with_bdpt",
    ),
    Mutation(
        "photons/gather.py",
        "hit &= same_side(landing, vertices.n, towards)",
        "hit &= True",
        "light that grazes the inside of a lampshade shines through it",
        "tests/integrators/test_bdpm.py::test_no_light_through_curved_sheets",
    ),
    Mutation(
        "photons/pairs.py",
        "active = active & same_side(landing, vertices.n, towards)",
        "active = active & True",
        "pairs of published weights let light through a lampshade",
        "tests/integrators/test_bdpm.py::test_no_light_through_curved_sheets",
    ),
    Mutation(
        "paths/bent_surfaces.py",
        "(uu * v - uv * u) * dn_dv",
        "(uu * v - uv * u) * dn_du",
        "probes of covered disks look beside surfaces that are bent one way only",
        "tests/photons/test_coverage.py",
    ),
    Mutation(
        "photons/frozen.py",
        "hit &= dr.dot(photon.normal, facing) > SAME_SURFACE_COSINE",
        "hit &= dr.abs(dr.dot(photon.normal, facing)) > SAME_SURFACE_COSINE",
        "cached irradiance has light of the other side of a bent sheet",
        "tests/photons/test_frozen.py",
    ),
    Mutation(
        "photons/queries.py",
        "return dr.select(active, rest, 1)",
        "return dr.select(active, 1, rest)",
        "what photons bring by the even part of plastic counts once more on the path that goes on",
        "tests/integrators/test_narrow_lobes.py::test_means",
    ),
    Mutation(
        "photons/queries.py",
        """brought = throughput * state["rest"][0] if self.parts else throughput""",
        "brought = throughput",
        "photons in fog shine on the even part of a coated surface twice",
        "tests/integrators/test_bdpm_media.py::test_narrow_lobes_are_passed",
    ),
    Mutation(
        "paths/lobes.py",
        "return dr.minimum(value, bound * dr.abs(wo.z))",
        "return bound",
        "photons bring the even part of a coat without its cosine",
        "tests/integrators/test_narrow_lobes.py::test_means",
    ),
    Mutation(
        "lights/environment_guide.py",
        "JUMP = -1.37e-4",
        "JUMP = 0.0",
        "strategies take the same sun for two where a coordinate of its direction is zero",
        TRANSPORT,
    ),
    Mutation(
        "paths/light_classes.py",
        "self.entries = {**zeros, **(entries or {})}",
        "self.entries = {**(entries or {}), **zeros}",
        "layers lack the merged light of all rounds but the last",
        "tests/integrators/test_aovs.py::test_split_of_merges_in_rounds",
    ),
    Mutation(
        "pilot/run.py",
        "settled is not None and done == FEWEST_ITERATIONS and settled(found := result())",
        "settled is not None and done == FEWEST_ITERATIONS and (found := result())",
        "pilots end after their fewest iterations where photons render, too",
        "tests/integrators/test_auto.py::test_the_pilot_ends_once_path_has_won",
    ),
    Mutation(
        "photons/queries.py",
        "passed = passed | at.edge",
        "passed = passed & ~at.edge",
        "paths count legs and leaves that they pass, and gather nowhere",
        "tests/integrators/test_edges.py::test_means",
    ),
    Mutation(
        "photons/queries.py",
        "at.ends, at.even = at.ends & ~at.edge, at.even & ~at.edge",
        "at.ends = at.ends & ~at.edge",
        "photons bring the even part of coats on legs, too dark",
        "tests/integrators/test_edges.py::test_means",
    ),
    Mutation(
        "photons/disk_walls.py",
        "return furthest > BEHIND",
        "return furthest > 1e30",
        "photons of outdoors light a room through its walls",
        "tests/photons/test_disk_walls.py::test_no_light_leaks_into_a_room",
    ),
    Mutation(
        "photons/gather.py",
        "a + dr.select(there, b, 0)",
        "a",
        "all photons behind walls are lost",
        "tests/photons/test_disk_walls.py::test_what_is_seen_behind_walls_counts",
    ),
    Mutation(
        "integrators/pilot_passes.py",
        "[share for share, _ in found]",
        "[share * 0 + 1 for share, _ in found]",
        "pilots do not correct at edges",
        "tests/photons/test_disk_walls.py::test_pilots_correct_each_radius",
    ),
    Mutation(
        "photons/gather.py",
        "apart > OFF_SHEET * r",
        "apart > r",
        "the next slat of a blind lights this one",
        "tests/photons/test_disk_walls.py::test_photons_on_another_sheet_must_be_seen",
    ),
    Mutation(
        "photons/gather.py",
        "brings = value * vertices.factor",
        "brings = value * 0 + 1",
        "photons behind walls are tested regardless of what they bring",
        "tests/photons/test_disk_walls.py::test_light_of_another_colour",
    ),
    Mutation(
        "integrators/film_trial.py",
        "np.mean(weight * found, axis=(1, 2))",
        "np.array([np.sort((weight * one).ravel())[:-4].mean() for one in found])",
        "rare light counts for nothing in the first images",
        "tests/integrators/test_film_trial.py::test_rare_light_counts",
    ),
    Mutation(
        "integrators/film_trial.py",
        "window_mean(mean, NEAR)",
        "mean",
        "pixels that are bright by chance say so themselves",
        "tests/integrators/test_film_trial.py::test_rare_light_counts",
    ),
    Mutation(
        "integrators/choice.py",
        "return self.done + budget / self.cost",
        "return budget / self.cost",
        "iterations that are rendered ahead are forgotten",
        "tests/integrators/test_film_trial.py::test_what_is_rendered_counts",
    ),
    Mutation(
        "pilot/noise.py",
        "bounded_by_larger_disks(radii, own, floor, disks)",
        "bounded_by_larger_disks(radii, variance, floor, disks)",
        "the error of shared noise at large disks counts at small ones by the ratio of areas",
        "tests/pilot/test_denoiser.py::test_few_iterations_tell_the_noise",
    ),
    Mutation(
        "pilot/noise.py",
        "for used in ([0, 1], [0], [1]):",
        "for used in ([1],):",
        "noise that near pixels share falls with the area of disks, wherever these are",
        "tests/pilot/test_denoiser.py::test_few_iterations_tell_the_noise",
    ),
    Mutation(
        "lights/environment_guide.py",
        "last if last <= high + margin else high",
        "high",
        "photons of light that falls at the end of a room are as heavy as hundreds of others",
        "tests/lights/test_focus.py::test_a_room_is_in_focus_to_its_end",
    ),
    Mutation(
        "photons/tiers.py",
        "dr.maximum(lobe_width * radius, first)",
        "mi.Float(radius)",
        "photons that lie apart have wide disks on glossy floors, too",
        "tests/photons/test_tiers.py::test_tiers_bring_what_brute_force_finds",
    ),
    Mutation(
        "integrators/photon_passes.py",
        "[radius * vertices.lobe_width for radius in radii]",
        "[radius for radius in radii]",
        "glossy floors show blurred images of lamps behind glass",
        "tests/integrators/test_narrow_lobes.py::test_glossy_floors_show_sharp_images",
    ),
    Mutation(
        "integrators/choice.py",
        "values = np.where(np.isfinite(values), values, 0)",
        "values = np.asarray(values)",
        "`path` renders where one of its samples is not a number",
        "tests/integrators/test_auto.py::test_samples_that_are_not_finite",
    ),
    Mutation(
        "integrators/piloted.py",
        "self._left(OVERTIME * self.gathering_seconds)",
        "self._left(self.gathering_seconds)",
        "a single iteration has no more paths for direct light: lamps have ragged edges",
        "tests/integrators/test_direct_paths.py::test_none_where_there_is_no_time",
    ),
    Mutation(
        "integrators/bdpm.py",
        "self.accumulator.direct_noise = self.direct_light.noise_of_iteration",
        "self.accumulator.direct_noise = None",
        "direct light of a single iteration is denoised as if it were all noise",
        "tests/integrators/test_direct_paths.py::test_noise_of_an_iteration",
    ),
]
