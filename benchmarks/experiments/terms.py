"""The terms of the noise law of photon mapping, measured at the numbers of paths that there are.

Ershov et al. 2019: variance of an iteration = X / (N_F N_B) + B / N_B + (1 - 1 / N_B) F / N_F, the
cross, camera and photon terms. B / N_B is what camera paths alone vary by, under the mean over
light sub-paths; F / N_F the same the other way round. Neither mean is known, but two images that
share their camera paths and no light sub-paths have B / N_B for their covariance, whatever N_F is;
two that share their light sub-paths have F / N_F. What is left of the variance is the cross term.
"""

from __future__ import annotations

import argparse

from mis_integrators.app import loading
from mis_integrators.core.film import grey_and_weight
from mis_integrators.core.session import Session

import numpy as np

from common.methods import Method
from common.rows import Row, console, tell
from common.scene_files import OpenScene, merge_radius

COLUMNS = (
    "scene",
    "N_B",
    "N_F",
    "method",
    "variance",
    "cross share",
    "camera share",
    "photon share",
    "B",
    "F / N_F",
    "error of a share",
)
GROUPS = 8
"""Groups of pixels, from whose spread the error is estimated."""
OTHERS = 1 << 20
"""Numbers of iterations from here on are those of other paths."""


class Mixed:
    """Iterations of a session whose camera paths and light sub-paths have numbers of their own."""

    def __init__(self, session: Session):
        from mis_integrators.integrators.purposes import CAMERA  # needs a variant

        self.session, self.camera = session, 0
        sequence = session._sequence

        def numbered(iteration, purpose, group_size):
            number = self.camera if purpose == CAMERA else iteration
            return sequence(number, purpose, group_size)

        session._sequence = numbered

    def image(self, camera: int, light: int) -> np.ndarray:
        """Mean over the channels, (height, width), of one iteration."""
        self.camera = camera
        blocks = [self.session._iteration(light)]
        (grey,), (weight,) = grey_and_weight(self.session.sensor.film(), blocks)
        return grey / np.maximum(weight, 1e-12)


def measure(session: Session, rounds: int, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Variance, covariance with the camera paths in common and with the light sub-paths in common:
    means over the pixels of each group, relative to the squared image, (3, GROUPS); and the same of
    all pixels, (3,)."""
    mixed = Mixed(session)
    session.start()
    images = []
    for number in range(rounds):
        other = OTHERS + number
        images.append(
            [mixed.image(number, number), mixed.image(number, other), mixed.image(other, number)]
        )
        tell(f"{label} {number + 1}")
    one, camera, light = (np.stack(kind) for kind in zip(*images))
    mean = np.mean([one, camera, light], axis=(0, 1))
    deviations = [values - values.mean(axis=0) for values in (one, camera, light)]
    scale = 1 / (mean**2 + (0.1 * mean.mean()) ** 2) / (rounds - 1)
    products = np.stack([(deviations[0] * other).sum(axis=0) * scale for other in deviations])
    flat = products.reshape(3, -1)
    order = np.random.default_rng(0).permutation(flat.shape[1])
    groups = np.array_split(flat[:, order], GROUPS, axis=1)
    return np.stack([group.mean(axis=1) for group in groups], axis=1), flat.mean(axis=1)


def shares(variance: float, camera: float, light: float, n_b: int) -> tuple[float, ...]:
    """The cross, camera and photon terms as shares of the variance."""
    photon = (1 - 1 / n_b) * light
    return (variance - camera - photon) / variance, camera / variance, photon / variance


def compare(opened: OpenScene, camera_paths: int, options: argparse.Namespace) -> list[Row]:
    """A row a method that merges photons."""
    radius = merge_radius(opened, options)
    common = {"initial_radius": radius, "camera_paths": camera_paths}
    # Numbers that are independent, and none for direct light alone: the law is about these.
    common |= {"sampler": "independent", "direct_paths": 1}
    rows: list[Row] = []
    for method in options.integrators:
        try:
            own = Method(method.label, method.plugin, {**common, **method.parameters})
            session = own.integrator(opened).session(opened.scene, opened.sensor, seed=1)
            groups, (variance, camera, light) = measure(
                session, options.iterations, f"{opened.name}: {method.label}"
            )
        except loading.SCENE_ERRORS as error:
            console.print(f"{opened.name}: {method.label} left out: {loading.one_line(error)}")
            continue
        n_f = session.light_path_count
        cross, of_camera, of_photons = shares(variance, camera, light, camera_paths)
        spread = np.array([shares(*group, camera_paths) for group in groups.T])
        rows.append(
            {
                "scene": opened.name,
                "N_B": camera_paths,
                "N_F": n_f,
                "method": method.label,
                "variance": float(variance),
                "cross share": float(cross),
                "camera share": float(of_camera),
                "photon share": float(of_photons),
                "B": float(camera) * camera_paths,
                "F / N_F": float(light),
                "error of a share": float(spread.std(axis=0, ddof=1).max() / GROUPS**0.5),
            }
        )
    return rows
