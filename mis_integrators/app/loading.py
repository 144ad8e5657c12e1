"""Load a Mitsuba scene, its integrator replaced (the old one is never built) or its parameters set.

The scene may be a stranger's: no library is loaded but those of Mitsuba itself.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from .._plugins import PLUGINS
from ..core.traits import check_film

Value = int | float | bool | str

# What a replacement takes over from the scene's integrator, if it knows it.
INHERITED = ("max_depth", "rr_depth", "hide_emitters")

# What Mitsuba and the integrators raise for a scene or a parameter that is wrong.
SCENE_ERRORS = (RuntimeError, ValueError, ImportError)

MITSUBA = Path(mi.__file__).parent
"""The folder in which Mitsuba finds its own plugins."""

LARGEST_INTEGER = 2**63 - 1
"""Integers beyond this are none to Mitsuba."""


@dataclass
class LoadedScene:
    """A scene, its integrator, and what the integrator was built from."""

    scene: mi.Scene
    integrator: mi.Integrator
    plugin: str
    parameters: dict[str, Value]


def load(
    path: Path,
    variables: Mapping[str, str],
    plugin: str | None,
    parameters: Mapping[str, Value],
    sampler: str | None = None,
    denoise: bool = False,
) -> LoadedScene:
    """Load the scene of an XML file under the active variant.

    ``variables`` are the values of the scene's ``$variables``. ``plugin`` replaces its integrator,
    which hands on the parameters ``INHERITED``; ``parameters`` are then set on the integrator,
    replaced or not; ``sampler`` replaces the sensors' samplers, but not their numbers of samples;
    ``denoise`` suits all to a denoiser: the films' reconstruction filters become boxes, and an
    integrator that has the parameter ``denoised`` is told, unless it is given.
    Raises one of ``SCENE_ERRORS`` (see ``one_line``).
    """
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_file(config, str(path), **variables)
    if state.root.type != mi.ObjectType.Scene:
        raise RuntimeError(f'"{path}" is not a scene')
    mi.file_resolver().prepend(str(path.parent))
    _keep_out_foreign_libraries(
        [node.props.plugin_name() for node in state.nodes] + ([plugin] if plugin else [])
    )
    mi.parser.transform_all(config, state)
    node = _integrator_node(state) or _add_integrator(state)
    if plugin:
        inherited = {
            name: value
            for props in [*_nested_integrators(state, node), node.props]
            for name, value in _plain(props).items()
            if name in INHERITED
        }
        node.props = _properties(plugin, _known_to(plugin, inherited, parameters))
    for name, value in parameters.items():
        node.props[name] = value
    if denoise:
        _use_box_filters(state)
        if knows_of_denoisers(node.props.plugin_name(), _plain(node.props)):
            node.props["denoised"] = node.props.get("denoised", True)
    name, given = node.props.plugin_name(), _plain(node.props)

    if sampler:
        _replace_samplers(state, sampler)
    scene = mi.parser.instantiate(config, state)
    for sensor in scene.sensors():
        check_film(sensor, name)
    return LoadedScene(scene, scene.integrator(), name, given)


def knows_of_denoisers(plugin: str, parameters: Mapping[str, Value]) -> bool:
    """Whether an integrator has the parameter ``denoised``."""
    unknown = _unqueried(plugin, {"denoised": True, **parameters})
    return unknown is not None and "denoised" not in unknown


def parse_value(text: str) -> Value:
    """The value that a text means: an integer (up to ``LARGEST_INTEGER``), a float, a boolean
    (``true``, ``false``), else the text."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            value = kind(text)
        except ValueError:
            continue
        if kind is float or abs(value) <= LARGEST_INTEGER:
            return value
    return text


def one_line(error: BaseException) -> str:
    """The message of an error in one line, without the Python traceback that Mitsuba includes in
    its own."""
    while error.__cause__:
        error = error.__cause__
    text = re.sub(r"^\[[\w.]+:\d+\] ", "", str(error))
    place, traceback, rest = text.partition("Traceback (most recent call last):")
    if traceback:
        # The message follows the last frame, which is indented, as its source line is.
        frames_end = max(
            match.end() for match in re.finditer(r'^  File ".*\n(?:    .*\n)*', rest, re.MULTILINE)
        )
        text = place + re.sub(r"^[\w.]+: ", "", rest[frames_end:])
    return " ".join(text.split()) or type(error).__name__


def _keep_out_foreign_libraries(names: list[str]) -> None:
    """See to it that plugins come from Mitsuba's own folder, whatever lies beside the scene or in
    the current folder.

    Mitsuba loads a plugin from the first folder of its file resolver that has ``plugins`` with a
    library of that name. Where it would not find its own one, that is loaded now, and stays. Raises
    ``RuntimeError`` where one of the ``names`` is more than a name, or where there is a library for
    a plugin that is none of Mitsuba's.
    """
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_]+", name):
            raise RuntimeError(
                f'{name!r} is not the name of a plugin: only letters, digits and "_" are allowed'
            )
    own = {library.stem: library for library in (MITSUBA / "plugins").iterdir()}
    suffix = next(iter(own.values())).suffix
    for name in sorted({*names, *PLUGINS} - set(own)):
        if library := _foreign_library(f"{name}{suffix}"):
            raise RuntimeError(
                f'{library} is not loaded for the plugin "{name}": only plugins in Mitsuba\'s '
                "own folder are; remove this file"
            )
    _load_own([name for name, library in own.items() if _foreign_library(library.name)])


def _foreign_library(file_name: str) -> str | None:
    """The library of that name that Mitsuba would load from another folder than its own, if there
    is one."""
    found = str(mi.file_resolver().resolve(f"plugins/{file_name}"))
    own = MITSUBA / "plugins" / file_name
    return (
        found
        if os.path.exists(found) and not (own.exists() and os.path.samefile(found, own))
        else None
    )


def _load_own(names: Iterable[str]) -> None:
    """Have Mitsuba load plugins from its own folder."""
    resolver = mi.file_resolver()
    folders = [str(folder) for folder in resolver]
    resolver.clear()
    resolver.append(str(MITSUBA))
    try:
        for name in names:
            mi.PluginManager.instance().plugin_type(name)
    finally:
        resolver.clear()
        for folder in folders:
            resolver.append(folder)


def _integrator_node(state: Any) -> Any:
    """The node of the scene's integrator, which is no part of another integrator; ``None`` if it
    has none."""
    nodes = [node for node in state.nodes if node.type == mi.ObjectType.Integrator]
    inner = {index for node in nodes for index in _children(node)}
    outer = [
        node
        for index, node in enumerate(state.nodes)
        if node.type == mi.ObjectType.Integrator and index not in inner
    ]
    if len(outer) > 1:
        raise RuntimeError("the scene has more than one integrator")
    return outer[0] if outer else None


def _add_integrator(state: Any) -> Any:
    """Add the integrator that Mitsuba would use for a scene without one."""
    (index,) = _parts(state, 0, mi.ObjectType.Integrator, "_integrator")
    state.nodes[index].props = mi.Properties("path")
    return state.nodes[index]


def _replace_samplers(state: Any, plugin: str) -> None:
    """Make all samplers such plugins, also where Mitsuba would choose one."""
    for sensor in _nodes_of(state, mi.ObjectType.Sensor):
        own = _parts(state, sensor, mi.ObjectType.Sampler, "_sampler")
        counts = [
            {"sample_count": state.nodes[index].props["sample_count"]}
            for index in own
            if "sample_count" in state.nodes[index].props
        ]
        for index in own:
            state.nodes[index].props = _properties(plugin, counts[0] if counts else {})


def _use_box_filters(state: Any) -> None:
    """Give all films box filters, also those that have none of their own."""
    for film in _nodes_of(state, mi.ObjectType.Film):
        for index in _parts(state, film, mi.ObjectType.ReconstructionFilter, "_rfilter"):
            state.nodes[index].props = mi.Properties("box")


def _nodes_of(state: Any, kind: Any) -> list[int]:
    """Indices of the nodes of that type."""
    return [index for index, node in enumerate(state.nodes) if node.type == kind]


def _parts(state: Any, parent: int, kind: Any, name: str) -> list[int]:
    """Indices of the nodes of that type within node number ``parent``; where it has none, of one
    without properties that is added to it under that ``name``."""
    own = [index for index in _children(state.nodes[parent]) if state.nodes[index].type == kind]
    if own:
        return own
    node = mi.parser.SceneNode()
    node.type = kind
    state.nodes.append(node)
    added = len(state.nodes) - 1
    state.nodes[parent].props[name] = mi.Properties.ResolvedReference(added)
    return [added]


def _nested_integrators(state: Any, node: Any) -> list[Any]:
    """Properties of the integrators inside an integrator (``aov``, ``moment``)."""
    return [
        state.nodes[index].props
        for index in _children(node)
        if state.nodes[index].type == mi.ObjectType.Integrator
    ]


def _children(node: Any) -> list[int]:
    """Indices of the nodes that a node contains."""
    return [
        value.index()
        for _, value in _items(node.props)
        if isinstance(value, mi.Properties.ResolvedReference)
    ]


def _plain(props: Any) -> dict[str, Value]:
    """The properties that are numbers or texts, by name."""
    return {
        name: value for name, value in _items(props) if isinstance(value, (bool, int, float, str))
    }


def _items(props: Any) -> list[tuple[str, Any]]:
    """Names and values of properties, from a copy: reading one marks it as known to the plugin."""
    return list(mi.Properties(props).items())


def _properties(plugin: str, values: Mapping[str, Value]) -> mi.Properties:
    props = mi.Properties(plugin)
    for name, value in values.items():
        props[name] = value
    return props


def _known_to(
    plugin: str, values: Mapping[str, Value], parameters: Mapping[str, Value]
) -> dict[str, Value]:
    """Those of the values that the integrator asks for when it is built with these parameters,
    without which it may not be built at all."""
    # Where it cannot be built from these alone, building the scene says why.
    unknown = _unqueried(plugin, {**values, **parameters}) or []
    return {name: value for name, value in values.items() if name not in unknown}


def _unqueried(plugin: str, values: Mapping[str, Value]) -> list[str] | None:
    """Names of those values that an integrator does not ask for; None where it cannot be built from
    these alone."""
    props = _properties(plugin, values)
    try:
        mi.PluginManager.instance().create_object(props)
    except SCENE_ERRORS:
        return None
    return list(props.unqueried())
