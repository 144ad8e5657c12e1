"""What a pilot would have found, said instead."""

import mitsuba as mi


def as_chosen(monkeypatch, radius, **settings):
    """What makes `bdpm` with `bdd` 0 and these `settings`, and more, whose pilot chooses this
    radius."""
    from mis_integrators.integrators.bdpm import BDPMSession

    def predict(session, settled=None):
        if session.radii is None:
            session.radii = dict.fromkeys(session.kinds(), radius)

    monkeypatch.setattr(BDPMSession, "predict", predict)
    return lambda **more: mi.load_dict({"type": "bdpm", "bdd": 0, **settings, **more})


def knowing(session, radii, iterations):
    """The session, which knows its `radii` (by kind, or one for all), as in a render of so many
    `iterations`: the more, the fewer photons are sparse."""
    most = session.caustic_radii.most_iterations
    session.recall(learned(session, radii, min(iterations, most)))
    return session


def learned(session, radii, iterations=0.0, **others):
    """What a session of photons can `recall`: `radii` by kind, or one for all; all light sub-paths,
    and caustic photons with radii for a render of so many `iterations` (0: all alike), but for
    `others`."""
    kinds = session.kinds()
    return {
        "radii": radii if isinstance(radii, dict) else dict.fromkeys(kinds, radii),
        "light_share": 1.0,
        "caustic_radii": {"iterations": iterations},
        "direct_light": {},
        **others,
    }
