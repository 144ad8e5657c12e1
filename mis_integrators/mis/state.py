"""What tracers ask of weights, and nothing else: the state of multiple importance sampling.

The weight of a path depends on all its vertices, so a sub-path carries running sums with it, as in
Georgiev, Implementing vertex connection and merging (2012): dVCM and dVC are two of them. A theory
of weights says what these sums are. The tracers (`paths`) only hand them on, in this order:

    init            at the first vertex
    propagate       on arriving at a later vertex
    scatter         on leaving a vertex
    hit_emitter     where a camera path meets a light
    next_event      where a vertex is joined with a point of a light

There are three protocols, for three kinds of sums: `ConnectionState` for vertices that are joined
(`bdpt`, `vcm`, `pcbpt`, `bdpt_ris`), `MergeState` for camera paths that gather photons (`bdpm_opt`,
`bdpm_balance`), and `LightState` for the photons that these gather. All arguments are Dr.Jit
arrays, one element a path; `active` or `mask` selects the elements that count. A state is a list
of arrays. What photons have kept is read by the theory that has written it.

Resampled camera sub-paths keep steps in place of sums: what they ask of weights, their docstring
says (`paths.camera_vertices.trace_camera_vertices`).
"""

from __future__ import annotations

from typing import Any, Protocol

from ..core.records import Layout

Array = Any
State = list[Any]


class ConnectionState(Protocol):
    """Sums of sub-paths whose vertices are joined: see `weights.bidirectional` for the equations.

    Densities "per projected solid angle" are those of a direction, over the geometric cosine.
    """

    states: tuple[str, ...]
    """Names of the numbers of a state, under which vertices keep them."""
    merging: Any
    """A `vertex_merging.Merging`, where vertices are merged, too; else `None`."""

    def blank(self, width: int) -> State:
        """A state before the first vertex."""

    def init_light(
        self, si: Any, source: Any, reachable: Array, active: Array, flux: Array
    ) -> State:
        """At the first vertex of a light sub-path. `source`: the point of the light, as of
        `Lights.sample_emission`; `reachable`: next-event estimation could bring the same light;
        `flux`: what the sub-path started with."""

    def init_camera(self, density: Array, active: Array) -> State:
        """At the first vertex of a camera sub-path. `density` [1/m^2]: that of camera rays there
        (`Lens.connect`), zero where the vertex cannot be joined with the sensor."""

    def propagate(
        self, state: State, density: Array, si: Any, squared: Array, depth: Array
    ) -> State:
        """At a later vertex. `density` [1/m^2]: with which the vertex was made, zero after a delta
        function; `squared` [m^2]: squared distance from the vertex before; `depth`: segments."""

    def scatter(
        self,
        state: State,
        p_forward: Array,
        p_back: Array,
        delta: Array,
        scattered: Array,
        vertex: Any,
    ) -> State:
        """After scattering. `p_forward`, `p_back`: densities per projected solid angle with which
        this side goes on, and with which the other side would go back; `delta`: a delta function
        scattered; `scattered` [1/sr]: mean of the BSDF over the channels; `vertex`: its `n`
        and `density` (a `VertexBSDF`, or a record)."""

    def depart(self, state: State, si: Any, mask: Array) -> State:
        """After `scatter`, of light sub-paths: the state may keep the vertex that they leave."""

    def hit_emitter(self, state: State, direct: Array, emission: Array, sampled: Array) -> Array:
        """Weight of emission that a camera path meets, after `scatter`. `sampled`: density per
        solid angle of the direction (zero: a delta function); `direct`: that of next-event
        estimation; `emission`: `Lights.emission_over_nee_pdf`."""

    def next_event(
        self,
        state: State,
        direct: Array,
        emission: Array,
        sampled: Array,
        p_back: Array,
        delta: Array,
        vertex: Any,
    ) -> Array:
        """Weight of next-event estimation. Arguments as of `hit_emitter`, but `emission` [1/m^2]
        is an area density at the vertex; `delta`: the light cannot be met; `vertex`: as
        of `scatter`."""


class MergeState(Protocol):
    """Sums of camera paths at whose smooth vertices photons are gathered."""

    weighs_points_of_lights: bool
    """Whether the weight of direct light depends on the point of the light: then
    `next_event_weight` gives a factor, beside that of `propagate`."""

    def init(self, width: int) -> State:
        """A state before the first vertex."""

    def propagate(
        self, state: State, si: Any, bsdf: Any, vertex: Array, mask: Array
    ) -> tuple[State, Array]:
        """At a smooth vertex, the number `vertex` of its path: the state, and the weight of direct
        light there (a spectrum)."""

    def scatter(
        self, state: State, si: Any, bsdf: Any, bs: Any, vertex: Array, mask: Array
    ) -> State:
        """After a smooth scattering into the local direction `bs.wo`."""

    def next_event_weight(self, state: State, ref: Any, ds: Any, mask: Array) -> Array:
        """Factor of the weight of the light of `ds` at the vertex `ref` (a spectrum); `state`:
        after leaving `ref` for the light."""

    def ends(self, bsdf: Any, vertex: Array, mask: Array) -> Array:
        """Whether no strategy goes on beyond the vertex, although there are more."""

    def stored(self, state: State) -> list[Array]:
        """Three spectra that are kept with the vertex."""

    def light_state(self) -> LightState | None:
        """What photons carry for these weights; `None` if nothing."""


class LightState(Protocol):
    """Sums of light sub-paths whose photons are gathered under weights.

    `layout`: the record that each photon has of them (`core.records`); `in_media`: volume photons
    have one, too, of what `volume_words` returns.
    """

    layout: Layout
    in_media: bool

    def init(self) -> State:
        """Before the first vertex."""

    def first_vertex(self, state: State, si: Any, source: Any, straight: Array) -> State:
        """At a vertex that the light of the point `source` reaches on the lanes `straight`, where
        next-event estimation could bring the same light."""

    def scatter(self, state: State, si: Any, bsdf: Any, wo: Any, mask: Array) -> State:
        """After a smooth scattering into the local direction `wo`."""

    def words(self, state: State) -> list[Array]:
        """What is stored with a photon: the words of a record of the `layout`."""

    def volume_words(self, state: State) -> list[Array]:
        """What is stored with a volume photon, where these have a record."""
