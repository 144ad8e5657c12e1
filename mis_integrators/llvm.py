"""Find a libLLVM that works with Dr.Jit.

LLVM 14, 15 and 16 abort the process while they generate code for Dr.Jit ("Cannot select:
fminimum"), which no program can catch, so such a version is refused before it is used. A version
newer than those that were tested is used where there is no other.

This file uses the standard library alone and runs by itself: ``python llvm.py`` prints the library
it would choose, or says on standard error what to install and exits with status 1. ``python llvm.py
versions`` prints the oldest and the newest version that are tested.
"""

import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Mapping
from pathlib import Path

OLDEST_WORKING, NEWEST_TESTED = 17, 22
VARIABLE = "DRJIT_LIBLLVM_PATH"

# Versions are read from file names only. Loading a library to call LLVMGetVersion would leave it in
# the process, and two libLLVM in one process clash (shared command line options). Once Dr.Jit has
# loaded its own, Dr.Jit is asked.
_IN_NAME = re.compile(r"libLLVM(?:-|\.so\.|\.)(\d+(?:\.\d+)*)")
_IN_PATH = re.compile(r"llvm(?:@|-|/)(\d+(?:\.\d+)*)/")

chosen: Path | None = None
"""The library that ``make_known`` has chosen in this process; ``None`` if it was not asked to, or
found none."""

_INSTALL = (
    f"install LLVM {OLDEST_WORKING} to {NEWEST_TESTED}: `apt-get install libllvm19` (Debian, "
    "Ubuntu), `dnf install llvm-libs` (Fedora), "
    "`pacman -S llvm-libs` (Arch), `conda install -c conda-forge libllvm19`, or `brew install "
    "llvm@19` (macOS)"
)


class LLVMError(ImportError):
    """No working LLVM for an ``llvm_*`` variant; the message says what to do."""


def version_of(library: Path) -> tuple[int, ...] | None:
    """Version of a libLLVM as its resolved path tells it, such as ``(19, 1)``, or ``None``."""
    path = library.resolve()
    found = _IN_NAME.search(path.name) or _IN_PATH.search(path.as_posix())
    return tuple(int(part) for part in found[1].split(".")) if found else None


def is_tested(library: Path) -> bool:
    """Whether a libLLVM is of one of the versions that are tested, as far as its path tells."""
    version = version_of(library)
    return version is not None and OLDEST_WORKING <= version[0] <= NEWEST_TESTED


def best_working(libraries: Iterable[Path]) -> Path | None:
    """The library of the highest version that is tested; where there is none, of the lowest that is
    newer. The first one among equals."""
    versions = {library: version_of(library) or (0,) for library in libraries}
    if tested := [library for library in versions if is_tested(library)]:
        return max(tested, key=versions.__getitem__)
    return min(
        (library for library in versions if versions[library][0] > NEWEST_TESTED),
        key=versions.__getitem__,
        default=None,
    )


def library_directories(environment: Mapping[str, str], root: Path = Path("/")) -> list[Path]:
    """Directories below ``root`` that may hold a libLLVM, in order of preference."""
    usr, local, brew = root / "usr", root / "usr/local", root / "opt/homebrew"
    multiarch = sysconfig.get_config_var("MULTIARCH") or "lib"
    directories = [Path(p) for p in environment.get("LD_LIBRARY_PATH", "").split(":") if p]
    if environment.get("CONDA_PREFIX"):
        directories.append(Path(environment["CONDA_PREFIX"], "lib"))
    directories += [
        usr / "lib" / multiarch,
        usr / "lib64",
        usr / "lib",
        local / "lib64",
        local / "lib",
    ]
    for parent, pattern in (
        (usr / "lib", "llvm-*/lib"),
        (usr / "lib64", "llvm*/lib*"),
        (brew / "opt", "llvm*/lib"),
        (local / "opt", "llvm*/lib"),
    ):
        directories += sorted(parent.glob(pattern))
    return directories


def libraries_in(directories: Iterable[Path]) -> list[Path]:
    """All files in the directories that are named like the shared library of LLVM's C interface."""
    return [
        file
        for directory in directories
        for pattern in ("libLLVM.*", "libLLVM-[0-9]*")
        for file in sorted(directory.glob(pattern))
        if re.search(r"\.(so[.\d]*|dylib)$", file.name)
    ]


def libraries_in_linker_cache(listing: str) -> list[Path]:
    """The libLLVM of the listing that ``ldconfig -p`` prints, without those of a foreign word
    size."""
    return [
        Path(line.split("=>")[1].strip())
        for line in listing.splitlines()
        if re.match(r"\s*libLLVM[-.].*\(libc6,[^)]*\) => ", line)
    ]


def choose(environment: Mapping[str, str], root: Path = Path("/")) -> Path | None:
    """The best libLLVM of this system (see ``best_working``), or ``None``. ``DRJIT_LIBLLVM_PATH``
    is not looked at."""
    found = libraries_in(library_directories(environment, root))
    if root == Path("/"):
        found += libraries_in_linker_cache(_linker_cache())
    return best_working(found)


def problem_with_variable(environment: Mapping[str, str]) -> str | None:
    """What is wrong with the library that ``DRJIT_LIBLLVM_PATH`` names, or ``None``."""
    library = Path(environment[VARIABLE])
    if library.is_absolute() and not library.exists():
        return f"{VARIABLE} names {library}, which does not exist; correct or unset it"
    version = version_of(library)
    if version and version[0] < OLDEST_WORKING:
        return (
            f"{VARIABLE} names {library}, LLVM {version[0]}, which aborts the process in code "
            "generation; "
            f"unset it or name LLVM {OLDEST_WORKING} or newer"
        )
    return None


def make_known() -> None:
    """Set ``DRJIT_LIBLLVM_PATH`` to a library that works, unless it is set or Dr.Jit is already
    loaded.

    Dr.Jit looks for LLVM when it is imported, once. Nothing is raised here: a program that uses
    another backend needs no LLVM (see ``require``).
    """
    if os.environ.get(VARIABLE) or "drjit" in sys.modules:
        return
    library = choose(os.environ)
    if library:
        os.environ[VARIABLE] = str(library)
        global chosen
        chosen = library


def problem() -> str | None:
    """Why the ``llvm_*`` variants cannot be used in this process, in one line, or ``None``. Loads
    Dr.Jit."""
    import drjit as dr

    version = dr.detail.llvm_version()  # (-1, -1, -1) if Dr.Jit loaded none
    if version[0] >= OLDEST_WORKING:
        return None
    if os.environ.get(VARIABLE) and (wrong := problem_with_variable(os.environ)):
        return wrong
    loaded = (
        f"Dr.Jit has loaded LLVM {version[0]}, which aborts the process in code generation"
        if version[0] > 0
        else "Dr.Jit has found no LLVM"
    )
    usable = choose(os.environ)
    if usable and str(usable) != os.environ.get(VARIABLE):
        return (
            f"{loaded}; import mis_integrators before mitsuba and drjit, or set {VARIABLE}={usable}"
        )
    return f"{loaded}; {_INSTALL}"


def require() -> None:
    """Raise ``LLVMError`` unless the ``llvm_*`` variants can be used in this process."""
    if message := problem():
        raise LLVMError(message)


def _linker_cache() -> str:
    for program in ("ldconfig", "/sbin/ldconfig"):
        try:
            return subprocess.run(
                [program, "-p"], capture_output=True, text=True, timeout=10
            ).stdout
        except (OSError, subprocess.SubprocessError):
            continue
    return ""


def _main(arguments: list[str]) -> int:
    if arguments == ["versions"]:
        print(OLDEST_WORKING, NEWEST_TESTED)
        return 0
    if os.environ.get(VARIABLE):
        library: Path | None = Path(os.environ[VARIABLE])
        message = problem_with_variable(os.environ)
    else:
        library = choose(os.environ)
        message = None if library else f"no working LLVM found; {_INSTALL}"
    print(message or library, file=sys.stderr if message else sys.stdout)
    return 1 if message else 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
