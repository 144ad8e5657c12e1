"""``python -m mis_integrators doctor`` says what is wrong with an installation; ``python -m
mis_integrators render`` is ``mis-render``."""

import sys

COMMANDS = "python -m mis_integrators doctor | render SCENE.xml ..."


def main(arguments: list[str]) -> int:
    """Run the command that the first argument names, and return its exit code."""
    name, *rest = arguments or [""]
    if name == "doctor" and not rest:
        from .app import doctor

        return doctor.main()
    if name == "render":
        import mis_render

        return mis_render.main(rest)
    print(f"usage: {COMMANDS}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
