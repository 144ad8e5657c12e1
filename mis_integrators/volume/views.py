"""The views of one scene: their sensors as one array, where their pictures lie in a common image,
and connections to them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.random import next_2d
from ..core.traits import UnsupportedScene, check_bands, children
from ..paths.layers import written

PARALLEL = "OrthographicCamera"
SENSORS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    PARALLEL: "orthographic",
}
MAX_VIEWS = 1024


def views_of(sensor):
    """The sensors that make a view each: the children of a `batch`, in its order, or the sensor
    itself."""
    return children(sensor, mi.Sensor) if sensor.class_name() == "BatchSensor" else [sensor]


def _number(value):
    """A parameter of a sensor, which may be an array of width one."""
    return float(np.array(value).ravel()[0])


def _pointers(objects, pointer_type):
    """Registry numbers of objects (0 for None)."""
    return mi.UInt32(
        [
            int(dr.reinterpret_array(mi.UInt32, pointer_type(o))[0]) if o is not None else 0
            for o in objects
        ]
    )


CAMERA = (
    "origin",
    "forward",
    "corner",
    "across",
    "down",
    "across_dual",
    "down_dual",
    "area",
    "lens_x",
    "lens_y",
    "focus",
    "near",
    "far",
    "parallel",
)


@dataclass
class Camera:
    """A perspective, thin lens or orthographic camera as vectors in world space. The film's image
    at unit depth has the `corner` (from the `origin`) and the edges `across` and `down`, whose dual
    basis turns points there into film coordinates in [0, 1]^2; it covers the `area`. `lens_x` and
    `lens_y` are half axes of the lens, sharp at depth `focus`; `near` and `far` are depths.
    `parallel` (0 or 1): whether all rays have the direction `forward` (orthographic cameras); then
    the image is the same at all depths, and `corner` lies across `forward`.

    Mitsuba's sensors are not asked while rendering: calls through arrays of sensors reach the
    batch, too, which remembers what it last saw.
    """

    origin: np.ndarray
    forward: np.ndarray
    corner: np.ndarray
    across: np.ndarray
    down: np.ndarray
    across_dual: np.ndarray
    down_dual: np.ndarray
    area: float
    lens_x: np.ndarray
    lens_y: np.ndarray
    focus: float
    near: float
    far: float
    parallel: float = 0.0

    @staticmethod
    def of(sensor):
        """Reads a sensor; where its film lies is learned from three of its rays, so that all its
        parameters count."""
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
        ray, _ = sensor.sample_ray(
            mi.Float(sensor.shutter_open()),
            mi.Float(0.5),
            mi.Point2f([0, 1, 0], [0, 0, 1]),
            mi.Point2f(0.5),
        )
        parallel = sensor.class_name() == PARALLEL
        if parallel:
            offset = np.array(ray.o, dtype=np.float64).reshape(3, 3) - matrix[:3, 3:4]
            depth = axes[:, 2] @ offset
            corners = offset - axes[:, 2:3] * depth
        else:
            d = np.array(ray.d, dtype=np.float64).reshape(3, 3)
            corners = d / (axes[:, 2] @ d)
        across, down = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        dual = np.linalg.pinv(np.stack([across, down], axis=1))
        parameters = mi.traverse(sensor)
        lens, focus = (
            _number(parameters[name]) if name in parameters else value
            for name, value in (("aperture_radius", 0), ("focus_distance", 1))
        )
        near, far = _number(parameters["near_clip"]), _number(parameters["far_clip"])
        if parallel:  # its clipping planes are scaled with `to_world`
            near = float(depth[0])
            far = near + float(np.array(ray.maxt).ravel()[0])
        return Camera(
            matrix[:3, 3],
            axes[:, 2],
            corners[:, 0],
            across,
            down,
            dual[0],
            dual[1],
            float(np.linalg.norm(np.cross(across, down))),
            lens * axes[:, 0],
            lens * axes[:, 1],
            focus,
            near,
            far,
            float(parallel),
        )


class Views:
    """N views in one list, paths numbered view by view, pixel by pixel.

    They are made of `groups`, sensors of the scene; a `batch` stands for its children, whose films
    have a share of its own film's width and nothing else that counts. Attributes: `sensors` (of the
    views), `members` (numbers of views of each group), `count` (N), `sizes` (N pairs, cropped width
    and height), `paths` (camera paths an iteration), `rfilter`. The views' pictures lie one above
    the other in an image of `atlas_size`, each with a margin that its reconstruction filter does
    not leave.
    """

    def __init__(self, groups, camera_paths, plugin):
        self.groups, self.camera_paths = groups, camera_paths
        members = [views_of(group) for group in groups]
        self.members = [len(m) for m in members]
        self.sensors = sensors = [sensor for m in members for sensor in m]
        self.count = len(sensors)
        films = [group.film() for group, m in zip(groups, members) for _ in m]
        media = [
            sensor.get_medium() or group.get_medium()
            for group, m in zip(groups, members)
            for sensor in m
        ]
        for group in groups:
            self.check_sensor(group, plugin)
        self._check(films, plugin)
        self.rfilter = films[0].rfilter()
        self.sizes = [tuple(int(x) for x in s.film().crop_size()) for s in sensors]
        self.borders = [self.rfilter.border_size() if f.sample_border() else 0 for f in films]
        self.margin = 2 * self.rfilter.border_size() + 1
        rows = np.cumsum([0] + [h + 2 * self.margin for _, h in self.sizes])
        self.tops = [int(r) + self.margin for r in rows[:-1]]
        self.atlas_size = (max(w for w, _ in self.sizes) + 2 * self.margin, int(rows[-1]))
        counts = [
            (w + 2 * b) * (h + 2 * b) * camera_paths for (w, h), b in zip(self.sizes, self.borders)
        ]
        self.paths = sum(counts)
        if self.paths >= 1 << 32:
            raise UnsupportedScene(
                f"{plugin}: an iteration has 2^32 camera paths or more; render fewer or smaller "
                "views at once"
            )

        cameras = [Camera.of(s) for s in sensors]
        self.table = {
            "first": from_numpy(mi.UInt32, np.cumsum([0] + counts[:-1])),
            "width": mi.UInt32([w for w, _ in self.sizes]),
            "height": mi.UInt32([h for _, h in self.sizes]),
            "border": mi.UInt32(self.borders),
            "top": mi.UInt32(self.tops),
            "medium": _pointers(media, mi.MediumPtr),
            "pixels": mi.Float([float(w * h) for w, h in self.sizes]),
            "open": mi.Float([s.shutter_open() for s in sensors]),
            "shutter": mi.Float([s.shutter_open_time() for s in sensors]),
            **{
                name: mi.Float(
                    np.stack([getattr(c, name) for c in cameras])
                    .astype(np.float32)
                    .ravel()
                    .tolist()
                )
                for name in CAMERA
            },
        }
        dr.make_opaque(self.table)
        self.needs_aperture = any(s.needs_aperture_sample() for s in sensors)
        self.has_parallel = any(s.class_name() == PARALLEL for s in sensors)
        self.needs_time = any(s.shutter_open_time() > 0 for s in sensors)

    @staticmethod
    def check_sensor(group, plugin):
        """Raises `UnsupportedScene` for a sensor that cannot be a view, or a batch of views."""
        for sensor in views_of(group):
            if sensor.class_name() not in SENSORS:
                raise UnsupportedScene(
                    f"{plugin}: sensor {sensor.class_name()} cannot be connected to; views are "
                    f"{' or '.join(SENSORS.values())} sensors, alone or in a batch"
                )
        film = group.film()
        check_bands(film, plugin)
        if len(views_of(group)) > 1 and tuple(film.size()) != tuple(film.crop_size()):
            raise UnsupportedScene(f"{plugin}: the film of a batch cannot be cropped")

    @staticmethod
    def check_layers(groups, layers, plugin):
        """Raises `UnsupportedScene` where `layers` (of `paths.layers`) are asked for, and there are
        several views."""
        if layers and sum(len(views_of(group)) for group in groups) > 1:
            raise UnsupportedScene(
                f'{plugin}: parameter "aovs" = {written(layers)!r}: of several views there are no '
                "layers"
            )

    def _check(self, films, plugin):
        if self.count > MAX_VIEWS:
            raise UnsupportedScene(
                f"{plugin}: {self.count} views, at most {MAX_VIEWS} are supported"
            )
        if len({str(f.rfilter()) for f in films}) > 1:
            raise UnsupportedScene(
                f"{plugin}: the views' films must have the same reconstruction filter"
            )
        responses = [[str(o) for o in children(s, mi.Texture)] for s in self.sensors]
        if any(r != responses[0] for r in responses):
            raise UnsupportedScene(
                f"{plugin}: the views must have the same sensor response function"
            )

    def read(self, name, view, active=True):
        """A view's entry of the table."""
        return dr.gather(type(self.table[name]), self.table[name], view, active)

    def read_vector(self, name, view, active=True):
        """A view's vector in the table."""
        return dr.gather(mi.Vector3f, self.table[name], view, active)

    def medium(self, view, active=True):
        """The medium that each view's sensor is declared to be in."""
        return dr.reinterpret_array(mi.MediumPtr, self.read("medium", view, active))

    def of_path(self, number):
        """The view of camera path `number`."""
        if self.count == 1:
            return mi.UInt32(0) * number
        table = self.table["first"]
        return (
            dr.binary_search(
                0,
                self.count,
                lambda i: dr.gather(mi.UInt32, table, dr.minimum(i, self.count - 1)) <= number,
            )
            - 1
        )

    def sample(self, number, wavelengths, rng, active):
        """Camera rays of paths `number`: `(view, ray, position, aperture, in_window)`, the position
        in pixels from the cropped film's corner, and whether it lies in the crop window (films may
        sample a border around it)."""
        view = self.of_path(number)
        border, width = self.read("border", view, active), self.read("width", view, active)
        height = self.read("height", view, active)
        pixel = (number - self.read("first", view, active)) // self.camera_paths
        row = dr.maximum(width + 2 * border, 1)
        pixel = mi.Vector2f(mi.Float(pixel % row) - border, mi.Float(pixel // row) - border)
        position = pixel + mi.Vector2f(next_2d(rng))
        aperture = next_2d(rng) if self.needs_aperture else mi.Point2f(0.5)
        time = self.read("open", view, active)
        if self.needs_time:
            time += rng.next_float32() * self.read("shutter", view, active)
        u, v = position.x / dr.maximum(width, 1), position.y / dr.maximum(height, 1)
        lens = self._lens(view, aperture, active)
        focus, forward = self.read("focus", view, active), self.read_vector("forward", view, active)
        corner, across, down = (
            self.read_vector(name, view, active) for name in ("corner", "across", "down")
        )
        on_plane = corner + u * across + v * down
        d = dr.normalize(on_plane * focus - lens)
        if self.has_parallel:
            parallel = self._is_parallel(view, active)
            d = dr.select(parallel, forward, d)
            lens = dr.select(parallel, on_plane, lens)
        per_depth = dr.rcp(dr.dot(d, forward))
        near = self.read("near", view, active) * per_depth
        ray = mi.Ray3f(
            mi.Point3f(self.read_vector("origin", view, active) + lens + d * near),
            d,
            time,
            wavelengths,
        )
        ray.maxt = self.read("far", view, active) * per_depth - near
        in_window = (
            (position.x >= 0) & (position.y >= 0) & (position.x < width) & (position.y < height)
        )
        # A box filter must not lose the rare sample that rounding moves to the next pixel.
        splat = pixel + 0.5 if self.rfilter.is_box_filter() else position
        return view, ray, splat, aperture, in_window

    def _is_parallel(self, view, active):
        return self.read("parallel", view, active) > 0.5

    def _lens(self, view, aperture, active):
        """Offset on the lens of the sample `aperture` (world space)."""
        if not self.needs_aperture:
            return mi.Vector3f(0)
        disk = mi.warp.square_to_uniform_disk_concentric(aperture)
        return disk.x * self.read_vector("lens_x", view, active) + disk.y * self.read_vector(
            "lens_y", view, active
        )

    def connect(self, view, p, aperture, active):
        """The line from `p` to a view: `(d, distance, density, position)`, the direction to the
        sensor, the distance to its near plane, the density of the view's camera rays through `p`
        per area across them [1/m^2], for paths a pixel (zero where the view does not see that way:
        density = pixels / (A cos^3 r^2), A the area of the film's image at unit depth; of parallel
        rays pixels / A), and the position on the film in pixels."""
        lens, forward = (
            self._lens(view, aperture, active),
            self.read_vector("forward", view, active),
        )
        line = mi.Vector3f(p - self.read_vector("origin", view, active)) - lens
        depth = dr.dot(line, forward)
        ahead = (
            active
            & (depth >= self.read("near", view, active))
            & (depth <= self.read("far", view, active))
        )
        on_plane = line * dr.rcp(dr.select(ahead, depth, 1)) + lens * dr.rcp(
            self.read("focus", view, active)
        )
        if self.has_parallel:
            parallel = self._is_parallel(view, active)
            on_plane = dr.select(parallel, line - forward * depth, on_plane)
        from_corner = on_plane - self.read_vector("corner", view, active)
        u, v = (
            dr.dot(from_corner, self.read_vector(name, view, active))
            for name in ("across_dual", "down_dual")
        )
        length = dr.norm(line)
        cosine = depth * dr.rcp(dr.maximum(length, 1e-30))
        distance = length - self.read("near", view, active) * dr.rcp(dr.select(ahead, cosine, 1))
        seen = ahead & (u >= 0) & (u < 1) & (v >= 0) & (v < 1) & (distance > 0)
        density = self.read("pixels", view, active) * dr.rcp(
            self.read("area", view, active) * cosine * dr.square(depth)
        )
        d = line * -dr.rcp(dr.maximum(length, 1e-30))
        if self.has_parallel:
            distance = dr.select(parallel, depth - self.read("near", view, active), distance)
            seen = ahead & (u >= 0) & (u < 1) & (v >= 0) & (v < 1) & (distance > 0)
            even = self.read("pixels", view, active) * dr.rcp(self.read("area", view, active))
            density, d = dr.select(parallel, even, density), dr.select(parallel, -forward, d)
        position = mi.Point2f(
            u * self.read("width", view, active), v * self.read("height", view, active)
        )
        return (
            d,
            dr.select(seen, distance, 0),
            dr.select(seen, density, 0),
            position,
        )

    def place(self, view, position, active=True):
        """Film positions in the common image."""
        return mi.Point2f(
            position.x + self.margin, position.y + mi.Float(self.read("top", view, active))
        )
