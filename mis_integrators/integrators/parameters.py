"""Reading plugin parameters: types and ranges checked, unknown names refused, before any
sampling."""

from __future__ import annotations

from ..paths.layers import channel_names, parse_layers

REFUSED = {
    "samples_per_pass": 'iterations are passes already; use "camera_paths" and spp',
    "timeout": 'use "mis-render --time SECONDS"',
    "block_size": "there are no blocks: an iteration covers the whole film",
}


LARGEST_INTEGER = 2**31 - 1
"""Integers beyond this fit into no array of 32 bits."""


class ParameterError(ValueError):
    """A plugin parameter that is unknown, of the wrong type or out of range; the message says what
    is allowed."""


class Parameters:
    """Typed access to a plugin's `mi.Properties`; remembers what was asked for, so that the rest
    can be refused."""

    def __init__(self, props):
        self.props = props
        self.plugin = props.plugin_name()
        self.known = []
        for name, advice in REFUSED.items():
            self.refuse(name, advice)

    def _fail(self, name, value, allowed):
        raise ParameterError(
            f'{self.plugin}: parameter "{name}" = {value!r} is not allowed: expected {allowed}'
        )

    def _get(self, name, default):
        self.known.append(name)
        return self.props.get(name, default) if name in self.props else default

    def integer(self, name, default, low, allowed, high=LARGEST_INTEGER):
        """An integer in [low, high]; `allowed` is the range in words (that a number is too large is
        added where it does not say so)."""
        value = self._get(name, default)
        if type(value) is not int or value < low:
            self._fail(name, value, f"an integer, {allowed}")
        if value > high:
            self._fail(
                name,
                value,
                f"an integer, {allowed}" + ("" if str(high) in allowed else f", at most {high}"),
            )
        return value

    def number(self, name, default, accept, allowed):
        """A float for which `accept(value)` holds; `allowed` is the range in words."""
        value = self._get(name, default)
        if type(value) not in (int, float) or not accept(float(value)):
            self._fail(name, value, f"a number, {allowed}")
        return float(value)

    def exponent(self, name):
        """That of Veach's heuristics, an integer where it is a whole number: powers are cheap
        then."""
        value = self.number(
            name,
            1.0,
            lambda beta: 1 <= beta <= 8,
            "from 1 (balance) to 8; 2 is the power heuristic",
        )
        return int(value) if value == int(value) else value

    def boolean(self, name, default):
        """True or false."""
        value = self._get(name, default)
        if type(value) is not bool:
            self._fail(name, value, "true or false")
        return value

    def choice(self, name, default, allowed):
        """One of the words `allowed`."""
        value = self._get(name, default)
        if value not in allowed:
            self._fail(name, value, " or ".join(f'"{word}"' for word in allowed))
        return value

    def layers(self, name, types):
        """The layers (`paths.layers.Layer`) of some `types` that a text asks for."""
        text = self._get(name, "")
        try:
            return parse_layers(text if type(text) is str else repr(text), types)
        except ValueError as error:
            self._fail(
                name,
                text,
                f'pairs "name:type" with commas between them, types being {", ".join(types)}; '
                f"{error}",
            )

    def refuse(self, name, reason):
        """Refuses a parameter that other plugins have."""
        if name in self.props:
            raise ParameterError(f'{self.plugin}: parameter "{name}" is not supported: {reason}')

    def check_channels(self, layers, others):
        """Refuses layers whose channels are called like `others`."""
        for channel in channel_names(layers):
            if channel in others:
                raise ParameterError(
                    f'{self.plugin}: parameter "aovs": the channel "{channel}" is there already; '
                    "choose another name"
                )

    def finish(self):
        """Refuses whatever was given but not asked for."""
        unknown = [name for name in self.props.unqueried() if name not in self.known]
        if unknown:
            names = ", ".join(sorted(self.known))
            raise ParameterError(
                f'{self.plugin}: unknown parameter "{unknown[0]}"; allowed are: {names}'
            )
