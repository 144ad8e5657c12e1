"""No pass of any plugin is one that Dr.Jit cannot record: such a pass would render the same image,
more slowly. And its kernels are those of other renders of the scene."""

import re

from mis_integrators.pilot.run import PILOT_INDEX
from mis_integrators.pilot.setting import pilot_pixels

import drjit as dr
import mitsuba as mi
import pytest
from comparing import kernel_sources, kernels_of
from selection import extended
from test_bdpm import glossy_box


@pytest.mark.parametrize(
    "plugin",
    ["bdpm_opt3", "bdpt_ris", *extended("bdpm", "bdpm_balance", "bdpt", "vcm", "pcbpt")],
)
def test_passes_are_recorded(rgb, plugin, monkeypatch):
    said = []
    monkeypatch.setattr(mi, "Log", lambda level, text: said.append(text))
    scene = glossy_box()
    integrator = mi.load_dict({"type": plugin, "max_depth": 4})
    with dr.suspend_grad():
        session = integrator.session(scene, seed=1, spp=8)
        for _ in range(2):
            session.iterate()
    assert not [text for text in said if "not recorded" in text]


UNALIGNED = re.compile(r"load (?:i32|float), ptr \S+ align [12],")


@pytest.mark.parametrize("medium", [False, True])
def test_no_kernel_depends_on_where_numbers_lie(rgb, medium):
    """Where a kernel reads memory that NumPy has aligned as it pleased, another run may find no
    such kernel in the cache. That is seen in half of the sessions or more, so that eight in a row
    miss it with a probability below 1/250."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "ball": {"type": "sphere"}
            | (
                {"bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
                if medium
                else {"bsdf": {"type": "diffuse"}}
            ),
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16},
            },
        }
    )
    plugin = "volpath_multiview" if medium else "bdpm_auto"
    integrator, sessions = mi.load_dict({"type": plugin, "max_depth": 3}), []

    def render():
        for seed in range(8):
            sessions.append(integrator.session(scene, seed=seed, spp=2))
            sessions[-1].iterate()

    sources = kernel_sources(render)
    assert sources
    assert not [source for source in sources if UNALIGNED.search(source)]


LARGE = 500
"""Operations of kernels that take long to compile."""


@pytest.mark.parametrize("denoised", [False, True])
def test_pilot_and_render_trace_camera_paths_by_one_kernel(rgb, denoised):
    integrator = mi.load_dict({"type": "bdpm", "bdd": 0, "denoised": denoised})
    session = integrator.session(glossy_box(), seed=1, spp=2)
    session.start()  # with the room that a render has in the end
    setting = session.pilot_setting()
    pilot = session.pilot_passes(setting, pilot_pixels(setting))
    sequence = session._sequence(PILOT_INDEX, 0, pilot.pixels.camera_paths)
    spectral = session._spectral(PILOT_INDEX)
    of_pilot = kernels_of(lambda: pilot._trace_camera(sequence, spectral), LARGE)
    assert of_pilot and of_pilot <= kernels_of(session.iterate, LARGE)


@pytest.mark.parametrize("denoised", [False, True])
def test_trial_and_render_of_path_have_one_kernel(rgb, denoised):
    from mis_integrators.integrators import choice
    from mis_integrators.integrators.unidirectional import PathSession

    integrator = mi.load_dict({"type": "bdpm_auto", "denoised": denoised})
    session = PathSession(integrator, glossy_box(), glossy_box().sensors()[0], 1, 2)
    pixels = pilot_pixels(mi.load_dict({"type": "bdpm"}).session(glossy_box()).pilot_setting())
    of_trial = kernels_of(lambda: choice._samples(session, pixels, 0), LARGE)
    assert of_trial and of_trial == kernels_of(session.iterate, LARGE)


def test_lamps_of_the_cache_have_one_kernel(rgb):
    """The strongest light of a cell is looked for lamp by lamp: no lamp has kernels of its own."""
    made = []
    for count in (2, 6):
        lamps = {
            f"lamp{k}": {
                "type": "point",
                "position": [0.1 * k - 0.3, 0.5, 0.2],
                "intensity": {"type": "rgb", "value": 0.1 + 0.01 * k},
            }
            for k in range(count)
        }
        session = mi.load_dict({"type": "bdpm_opt2", "initial_radius": 0.05}).session(
            glossy_box(**lamps), seed=1, spp=2
        )
        made.append(len(kernels_of(session.start)))
    assert made[0] == made[1]
