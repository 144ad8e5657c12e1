"""The views of one scene: their sensors as one array, where their pictures lie in a common image, and connections to them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.random import next_2d
from ..transport.traits import UnsupportedScene, scene_objects

SENSORS = {"PerspectiveCamera": "perspective", "ThinLensCamera": "thinlens"}
MAX_VIEWS = 1024


def views_of(sensor):
    """The sensors that make a view each: the children of a `batch`, in its order, or the sensor itself."""
    if sensor.class_name() != "BatchSensor":
        return [sensor]

    class Children(mi.TraversalCallback):
        found = []

        def put(self, name, value, *flags):
            if isinstance(value, mi.Sensor):
                self.found.append(value)

    children = Children()
    children.found = []
    sensor.traverse(children)
    return children.found


def _pointers(objects, pointer_type):
    """Registry numbers of objects (0 for None)."""
    return mi.UInt32([int(dr.reinterpret_array(mi.UInt32, pointer_type(o))[0]) if o is not None else 0 for o in objects])


class Views:
    """N views in one list, paths numbered view by view, pixel by pixel.

    Attributes: `sensors`, `count` (N), `sizes` (N pairs, cropped width and height), `paths` (camera paths an iteration), `rfilter`.
    The views' pictures lie one above the other in an image of `atlas_size`, each with a margin that its reconstruction filter does not leave.
    """

    def __init__(self, sensors, camera_paths, plugin):
        self.sensors, self.count, self.camera_paths = sensors, len(sensors), camera_paths
        self._check(plugin)
        films = [s.film() for s in sensors]
        self.rfilter = films[0].rfilter()
        self.sizes = [tuple(int(x) for x in f.crop_size()) for f in films]
        self.borders = [self.rfilter.border_size() if f.sample_border() else 0 for f in films]
        self.margin = 2 * self.rfilter.border_size() + 1
        rows = np.cumsum([0] + [h + 2 * self.margin for _, h in self.sizes])
        self.tops = [int(r) + self.margin for r in rows[:-1]]
        self.atlas_size = (max(w for w, _ in self.sizes) + 2 * self.margin, int(rows[-1]))
        counts = [(w + 2 * b) * (h + 2 * b) * camera_paths for (w, h), b in zip(self.sizes, self.borders)]
        self.paths = sum(counts)
        if self.paths >= 1 << 32:
            raise UnsupportedScene(f"{plugin}: the views have more than 2^32 pixels together")

        matrices = [np.array(s.world_transform().matrix, dtype=np.float64).reshape(4, 4) for s in sensors]
        parameters = [mi.traverse(s) for s in sensors]
        self.table = {
            "first": mi.UInt32(np.cumsum([0] + counts[:-1])), "width": mi.UInt32([w for w, _ in self.sizes]),
            "height": mi.UInt32([h for _, h in self.sizes]), "border": mi.UInt32(self.borders), "top": mi.UInt32(self.tops),
            "sensor": _pointers(sensors, mi.SensorPtr), "medium": _pointers([s.get_medium() for s in sensors], mi.MediumPtr),
            "near": mi.Float([float(p["near_clip"]) for p in parameters]),
            "forward": mi.Float(np.concatenate([(m[:3, 2] / np.linalg.norm(m[:3, 2])) for m in matrices])),
            "pixels": mi.Float([float(w * h) for w, h in self.sizes]),
            "open": mi.Float([s.shutter_open() for s in sensors]), "shutter": mi.Float([s.shutter_open_time() for s in sensors]),
        }
        dr.make_opaque(self.table)
        self.needs_aperture = any(s.needs_aperture_sample() for s in sensors)
        self.needs_time = any(s.shutter_open_time() > 0 for s in sensors)
        self.needs_border = any(self.borders)

    @staticmethod
    def check_sensor(sensor, plugin):
        """Raises `UnsupportedScene` for a sensor that cannot be a view."""
        if sensor.class_name() not in SENSORS:
            raise UnsupportedScene(f"{plugin}: sensor {sensor.class_name()} cannot be connected to; views are "
                                   f"{' or '.join(SENSORS.values())} sensors, alone or in a batch")
        if mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special):
            raise UnsupportedScene(f'{plugin}: film "specfilm" is not supported; use "hdrfilm"')

    def _check(self, plugin):
        for sensor in self.sensors:
            self.check_sensor(sensor, plugin)
        if self.count > MAX_VIEWS:
            raise UnsupportedScene(f"{plugin}: {self.count} views, at most {MAX_VIEWS} are supported")
        if len({str(s.film().rfilter()) for s in self.sensors}) > 1:
            raise UnsupportedScene(f"{plugin}: the views' films must have the same reconstruction filter")
        responses = [[str(o) for o in scene_objects(s) if isinstance(o, mi.Texture)] for s in self.sensors]
        if any(r != responses[0] for r in responses):
            raise UnsupportedScene(f"{plugin}: the views must have the same sensor response function")

    def read(self, name, view, active=True):
        """A view's entry of the table."""
        return dr.gather(type(self.table[name]), self.table[name], view, active)

    def sensor(self, view, active=True):
        """Sensor pointers."""
        if self.count == 1:
            return mi.SensorPtr(self.sensors[0])
        return dr.reinterpret_array(mi.SensorPtr, self.read("sensor", view, active))

    def medium(self, view, active=True):
        """The medium that each view's sensor is declared to be in."""
        return dr.reinterpret_array(mi.MediumPtr, self.read("medium", view, active))

    def of_path(self, number):
        """The view of camera path `number`."""
        if self.count == 1:
            return mi.UInt32(0) * number
        table = self.table["first"]
        return dr.binary_search(0, self.count, lambda i: dr.gather(mi.UInt32, table, dr.minimum(i, self.count - 1)) <= number) - 1

    def sample(self, number, wavelength_sample, rng, active):
        """Camera rays of paths `number`: `(view, ray, weight, position, aperture, in_window)`, the position in pixels from the cropped film's corner,
        and whether it lies in the crop window (films may sample a border around it)."""
        view = self.of_path(number)
        border, width = self.read("border", view, active), self.read("width", view, active)
        height = self.read("height", view, active)
        pixel = (number - self.read("first", view, active)) // self.camera_paths
        row = dr.maximum(width + 2 * border, 1)
        corner = mi.Vector2f(mi.Float(pixel % row) - border, mi.Float(pixel // row) - border)
        position = corner + mi.Vector2f(next_2d(rng))
        unit = mi.Point2f(position.x / dr.maximum(width, 1), position.y / dr.maximum(height, 1))
        aperture = next_2d(rng) if self.needs_aperture else mi.Point2f(0.5)
        time = self.read("open", view, active)
        if self.needs_time:
            time += rng.next_float32() * self.read("shutter", view, active)
        ray, weight = self.sensor(view, active).sample_ray(time, wavelength_sample, unit, aperture, active)
        in_window = (position.x >= 0) & (position.y >= 0) & (position.x < width) & (position.y < height)
        # A box filter must not lose the rare sample that rounding moves to the next pixel.
        splat = corner + 0.5 if self.rfilter.is_box_filter() else position
        return view, ray, weight, splat, aperture, in_window

    def connect(self, view, it, aperture, active):
        """The line from `it` to a view: `(d, distance, density, position)`, the direction to the sensor, the distance to its near plane, the density of
        the view's camera rays through `it` per area across them [1/m^2] (zero where the view does not see that way), and the position on the film in pixels."""
        ds, weight = self.sensor(view, active).sample_direction(it, aperture, active)
        forward = dr.gather(mi.Vector3f, self.table["forward"], view, active)
        cosine = -dr.dot(forward, ds.d)
        near = self.read("near", view, active) * dr.rcp(dr.maximum(cosine, 1e-6))
        distance = ds.dist - near
        density = dr.mean(weight) * self.read("pixels", view, active)
        seen = active & (ds.pdf > 0) & (cosine > 1e-6) & (distance > 0) & (density > 0)
        return ds.d, dr.select(seen, distance, 0), dr.select(seen, density, 0), ds.uv

    def place(self, view, position, active=True):
        """Film positions in the common image."""
        return mi.Point2f(position.x + self.margin, position.y + mi.Float(self.read("top", view, active)))
