"""No pass of any plugin is one that Dr.Jit cannot record: such a pass would render the same image,
more slowly."""

import drjit as dr
import mitsuba as mi
import pytest
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
