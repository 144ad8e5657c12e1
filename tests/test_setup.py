"""Set-up: the choice of LLVM, the registration of plugins, and the package."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

from mis_integrators import _plugins, _tested, llvm
from mis_integrators.llvm import library_directories

import mitsuba as mi
import pytest
from conftest import LEFT_OUT

ROOT = Path(__file__).parent.parent
MULTIARCH = sysconfig.get_config_var("MULTIARCH") or "lib"


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess:
    """Run code in a fresh interpreter that sees this checkout."""
    inherited = {k: v for k, v in os.environ.items() if k != llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        env={**inherited, **environment},
    )


def library(root: Path, name: str, *links: str) -> Path:
    """An empty file named like a library, and symbolic links to it from elsewhere below
    ``root``."""
    file = root / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    for link in links:
        (root / link).parent.mkdir(parents=True, exist_ok=True)
        (root / link).symlink_to(file)
    return file


# --- Which LLVM ---------------------------------------------------------------


@pytest.mark.parametrize(
    "name, version",
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM-17.so.1", (17,)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM.so.22.1", (22, 1)),
        ("libLLVM.so", None),
        ("libfoo.so.19", None),
        ("Cellar/llvm/20.1.3/lib/libLLVM.dylib", (20, 1, 3)),
        ("opt/llvm@18/lib/libLLVM.dylib", (18,)),
        ("usr/lib/llvm-19/lib/libLLVM.so", (19,)),
    ],
)
def test_version_is_read_from_the_name(tmp_path, name, version):
    assert llvm.version_of(tmp_path / name) == version


def test_version_of_a_link_is_that_of_its_target(tmp_path):
    library(tmp_path, "real/libLLVM.so.19.1", "libLLVM.so")
    assert llvm.version_of(tmp_path / "libLLVM.so") == (19, 1)


def test_newest_working_library_is_chosen(tmp_path):
    library(tmp_path, f"usr/lib/{MULTIARCH}/libLLVM-15.so.1")
    library(tmp_path, f"usr/lib/{MULTIARCH}/libLLVM-17.so.1")
    newest = library(
        tmp_path, f"usr/lib/{MULTIARCH}/libLLVM.so.20.1", "usr/lib/llvm-20/lib/libLLVM.so.1"
    )
    library(tmp_path, "usr/lib64/libLLVM.so.19.1")
    assert llvm.choose({}, tmp_path) == newest


def test_versions_are_compared_as_numbers(tmp_path):
    library(tmp_path, "usr/lib/libLLVM-9.so.1")
    library(tmp_path, "usr/lib/libLLVM.so.18.9")
    eighteen = library(tmp_path, "usr/lib/libLLVM.so.18.10")
    assert llvm.choose({}, tmp_path) == eighteen


def test_newer_than_tested_is_the_last_resort(tmp_path):
    """The one nearest to what was tested."""
    library(tmp_path, "usr/lib/libLLVM.so.100.0")
    next_one = library(tmp_path, f"usr/lib/libLLVM.so.{llvm.NEWEST_TESTED + 1}.1")
    library(tmp_path, "usr/lib/libLLVM-16.so.1")
    assert llvm.choose({}, tmp_path) == next_one and not llvm.is_tested(next_one)
    tested = library(tmp_path, f"usr/lib/libLLVM.so.{llvm.NEWEST_TESTED}.1")
    assert llvm.choose({}, tmp_path) == tested and llvm.is_tested(tested)


def test_only_libraries_that_abort_means_none(tmp_path):
    for version in (14, 15, 16):
        library(tmp_path, f"usr/lib/{MULTIARCH}/libLLVM-{version}.so.1")
    library(tmp_path, "usr/lib/libLLVM.so.19.1-notes.txt")
    assert llvm.choose({}, tmp_path) is None


def test_library_of_a_conda_environment_is_found(tmp_path):
    found = library(tmp_path, "env/lib/libLLVM-19.so")
    assert llvm.choose({"CONDA_PREFIX": str(tmp_path / "env")}, tmp_path / "empty") == found


def test_linker_cache_is_read_without_foreign_libraries():
    listing = (
        "2 libs found in cache `/etc/ld.so.cache'\n"
        "\tlibLLVM.so.19.1 (libc6,x86-64) => /opt/llvm/libLLVM.so.19.1\n"
        "\tlibLLVM.so.20.1 (libc6) => /lib32/libLLVM.so.20.1\n"
        "\tlibLLVMSPIRVLib.so.14 (libc6,x86-64) => /lib/libLLVMSPIRVLib.so.14\n"
    )
    assert llvm.libraries_in_linker_cache(listing) == [Path("/opt/llvm/libLLVM.so.19.1")]


def test_variable_is_checked(tmp_path):
    good = library(tmp_path, "libLLVM.so.19.1")
    bad = library(tmp_path, "libLLVM-15.so.1")
    assert llvm.problem_with_variable({llvm.VARIABLE: str(good)}) is None
    assert "LLVM 15" in llvm.problem_with_variable({llvm.VARIABLE: str(bad)})
    assert "does not exist" in llvm.problem_with_variable(
        {llvm.VARIABLE: str(tmp_path / "none.so")}
    )


def test_variable_that_is_set_is_left_alone(tmp_path):
    result = run_python(
        "import os, mis_integrators; print(os.environ['DRJIT_LIBLLVM_PATH'])",
        DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"),
    )
    assert result.stdout.strip() == str(tmp_path / "none.so") and result.returncode == 0


def test_missing_llvm_is_an_error_only_when_it_is_needed(tmp_path):
    result = run_python(
        "import mis_integrators, mitsuba as mi; mi.set_variant('scalar_rgb'); print('fine')\n"
        "mis_integrators.llvm.require()",
        DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"),
    )
    assert result.stdout == "fine\n"
    assert "does not exist" in result.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "order",
    [
        "import mis_integrators\nmi.set_variant('llvm_ad_rgb')",
        "mi.set_variant('llvm_ad_rgb')\nimport mis_integrators",
    ],
)
def test_llvm_that_aborts_is_refused(order):
    """With a library that Dr.Jit would accept, and that would abort the process."""
    aborting = [
        file
        for file in llvm.libraries_in(library_directories({}))
        if (llvm.version_of(file) or (0,))[0] in (15, 16)
    ]
    if not aborting:
        pytest.skip("no LLVM 15 or 16 on this machine")
    result = run_python(f"import mitsuba as mi\n{order}", DRJIT_LIBLLVM_PATH=str(aborting[0]))
    assert result.returncode == 1
    assert "aborts the process" in result.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "python, environment, message",
    [
        (sys.executable, {llvm.VARIABLE: "/none.so"}, "does not exist"),
        ("no-such-python", {}, "does not run; install Python 3.10 or newer"),
        (None, {}, "is Python 3.9"),
    ],
)
def test_set_up_stops_with_one_message(tmp_path, python, environment, message):
    """What `make render` begins with says what to install, and makes nothing, where it cannot go
    on."""
    if python is None:
        python = tmp_path / "old-python"
        python.write_text(
            "#!/bin/sh\ncase $2 in *version_info\\ \\<*) exit 1;; *) echo 3.9;; esac\n"
        )
        python.chmod(0o755)
    result = subprocess.run(
        [ROOT / "tools" / "setup.sh", python, tmp_path / "venv"],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, **environment},
    )
    assert result.returncode == 1 and message in result.stderr and result.stderr.count("\n") == 1, (
        result.stderr
    )
    assert result.stderr.startswith("setup: ") and not (tmp_path / "venv").exists()


def command(folder: Path, name: str, code: str) -> Path:
    """A shell script of that name in a folder; an older one is replaced."""
    file = folder / name
    file.unlink(missing_ok=True)
    file.write_text(f"#!/bin/sh\n{code}\n")
    file.chmod(0o755)
    return file


@pytest.fixture
def set_up(tmp_path):
    """Runs `tools/setup.sh` where there is no LLVM until one is installed, as root, with commands
    that only take notes of what they are told."""
    tools, done, installed = tmp_path / "tools", tmp_path / "done", tmp_path / "installed"
    tools.mkdir()
    for name in ("awk", "bash", "cat", "dirname", "env", "sed", "sh", "sleep", "sort", "touch"):
        (tools / name).symlink_to(shutil.which(name))
    command(tools, "id", "echo 0")
    command(
        tools, "apt-get", f'echo "$@" >> {done}; case "$*" in *install*) touch {installed};; esac'
    )
    command(
        tools,
        "apt-cache",
        "for name in 16 17t64 19 19-dev 22 23 100; do echo libllvm$name; done",
    )
    python = command(
        tools,
        "python",
        f"""case "$*" in
        */llvm.py) [ -e {installed} ] || {{ echo "no working LLVM" >&2; exit 1; }};;
        "-m venv"*) ;;
        *) exec {sys.executable} "$@";;
    esac""",
    )

    def run(**environment):
        inherited = {name: value for name, value in os.environ.items() if name != llvm.VARIABLE}
        result = subprocess.run(
            [ROOT / "tools" / "setup.sh", python, tmp_path / "venv"],
            capture_output=True,
            text=True,
            timeout=60,
            env={**inherited, "PATH": str(tools), **environment},
        )
        return result, done.read_text().splitlines() if done.exists() else []

    run.tools = tools
    return run


def test_set_up_says_what_it_installs_before(set_up):
    """And takes the newest package of those tested, waiting for an apt that is at work."""
    result, done = set_up()
    assert result.returncode == 0, result.stderr
    update, install = done
    assert (
        update == "update -qq"
        and install.endswith(" libllvm22")
        and "DPkg::Lock::Timeout=" in install
    )
    first, second = result.stdout.splitlines()
    assert (
        "as root: apt-get update" in first
        and "as root: apt-get install libllvm22" in second
        and "NO_APT=1" in first
    )


def test_set_up_says_each_thing_before_it_does_it(set_up):
    command(set_up.tools, "apt-get", 'echo "E: no network" >&2; exit 100')
    result, _ = set_up()
    assert (
        result.returncode == 1
        and "apt-get update" in result.stdout
        and result.stderr == "setup: apt-get update failed: E: no network\n"
    )


def test_set_up_installs_nothing_if_told_so(set_up):
    result, done = set_up(NO_APT="1")
    assert (
        result.returncode == 1
        and done == []
        and result.stdout == ""
        and result.stderr == "setup: no working LLVM\n"
    )


def test_set_up_without_apt(set_up):
    (set_up.tools / "apt-get").unlink()
    result, done = set_up()
    assert result.returncode == 1 and done == [] and result.stderr == "setup: no working LLVM\n"


def test_set_up_does_not_install_what_was_not_tested(set_up):
    command(set_up.tools, "apt-cache", "echo libllvm16; echo libllvm23")
    result, done = set_up()
    assert (
        result.returncode == 1
        and done == ["update -qq"]
        and result.stderr == "setup: no working LLVM (apt knows no such package here)\n"
    )


def test_set_up_waits_for_another_update(set_up, tmp_path):
    """Apt itself waits for the lock of the packages only, not for that of their lists."""
    command(set_up.tools, "sleep", f"touch {tmp_path}/waited")
    command(
        set_up.tools,
        "apt-get",
        f"[ -e {tmp_path}/waited ] || "
        '{ echo "E: Could not get lock x." >&2; echo "E: no" >&2; exit 100; }; '
        f"touch {tmp_path}/installed",
    )
    result, _ = set_up()
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("program", ["apt-get", "dnf", "pacman", "brew", "conda"])
def test_message_says_how_to_install(program, monkeypatch, capsys):
    monkeypatch.setattr(llvm, "choose", lambda environment: None)
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    assert llvm._main([]) == 1
    error = capsys.readouterr().err
    assert f"`{program} " in error and error.count("\n") == 1


def test_tested_versions_are_printed(capsys):
    assert llvm._main(["versions"]) == 0
    assert capsys.readouterr().out == f"{llvm.OLDEST_WORKING} {llvm.NEWEST_TESTED}\n"


# --- Registration -------------------------------------------------------------

CHECK = """
def check(variant):
    assert mi.variant() == variant
    for plugin in mis_integrators._plugins.PLUGINS:
        made = mi.load_dict({"type": plugin})
        assert isinstance(made, mi.Integrator), made
"""


@pytest.mark.parametrize(
    "code",
    [
        "import mis_integrators, mitsuba as mi; mi.set_variant('llvm_ad_rgb')",
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mis_integrators",
    ],
    ids=["before", "after"],
)
def test_plugins_are_there_whatever_is_imported_first(code):
    result = run_python(
        f"{code}\n{CHECK}\ncheck('llvm_ad_rgb')\n"
        "mi.set_variant('llvm_ad_spectral'); check('llvm_ad_spectral')\n"
        "mi.set_variant('scalar_rgb')\n"
        "mi.set_variant('llvm_ad_rgb'); check('llvm_ad_rgb')"
    )
    assert result.returncode == 0, result.stderr


def test_scalar_variant_says_what_the_plugins_need():
    result = run_python(
        "import mis_integrators, mitsuba as mi; mi.set_variant('scalar_rgb')\n"
        "mi.load_dict({'type': 'bdpm'})"
    )
    assert "llvm_ad_*" in result.stderr.splitlines()[-1]


# --- Newer versions -----------------------------------------------------------


@pytest.mark.parametrize(
    "name, version", [("mitsuba", "3.10.0"), ("mitsuba", "4.0.0.dev1"), ("drjit", "1.6.0")]
)
def test_newer_version_is_one_line(name, version):
    result = run_python(
        f"import drjit, mitsuba; {name}.__version__ = '{version}'\n"
        "import mis_integrators, mis_integrators.app.loading"
    )
    assert result.returncode == 0 and result.stderr.count("\n") == 1
    assert (
        f"{name} {version} may not work: the newest tested are mitsuba 3.9 and drjit 1.5"
        in result.stderr
    )


def test_warning_of_a_newer_version_can_be_filtered():
    code = (
        "import warnings; warnings.filterwarnings('ignore', module='mis_integrators')\n"
        "import mitsuba; mitsuba.__version__ = '3.10.0'\n"
        "import mis_integrators"
    )
    result = run_python(code)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


@pytest.mark.parametrize(
    "versions",
    [
        {"mitsuba": "3.9.1", "drjit": "1.5.0"},
        {"mitsuba": "3.9.12", "drjit": "1.5.3.dev2"},
        {"mitsuba": "3.8.0", "drjit": "1.4"},
    ],
)
def test_tested_and_older_versions_are_not_warned_of(recwarn, versions):
    _tested.warn_of_newer(versions)
    assert not recwarn.list


def test_nothing_is_said_under_the_installed_versions():
    result = run_python("import mis_integrators")
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_newest_tested_versions_are_those_of_the_package():
    """What pip may install is what was tested."""
    text = (ROOT / "pyproject.toml").read_text()
    for name, (major, minor) in _tested.NEWEST.items():
        assert re.search(rf'"{name}>={major}\.{minor}\.\d+,<{major}\.{minor + 1}"', text), name


# --- The package --------------------------------------------------------------


def test_modules_that_define_plugin_classes_are_loaded_anew(rgb):
    """A class left over from another variant would be registered, and fail when a scene uses it."""
    for file in (ROOT / "mis_integrators" / "integrators").glob("[!_]*.py"):
        module = importlib.import_module(f"mis_integrators.integrators.{file.stem}")
        own = [
            cls
            for cls in vars(module).values()
            if isinstance(cls, type) and cls.__module__ == module.__name__
        ]
        if any(issubclass(cls, mi.Object) for cls in own):
            assert file.stem in _plugins.MODULES


def package_files() -> list[Path]:
    """All files of the package but what Python leaves there."""
    return [
        file
        for file in (ROOT / "mis_integrators").rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    ]


def test_files_that_are_no_modules_are_declared():
    """Setuptools leaves out of a wheel what pyproject.toml does not name."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.11 or newer reads TOML")
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    named = {
        file
        for package, patterns in declared.items()
        for pattern in patterns
        for file in ROOT.joinpath(*package.split(".")).glob(pattern)
    }
    data = {file for file in package_files() if file.suffix != ".py"}
    assert data and data <= named


def test_continuous_integration_runs_all_but_the_extended_and_the_full():
    """The default tests, and the long ones that these leave out."""
    targets = re.search(r"exec make ([-\w ]+)", ROOT.joinpath(".ci/run").read_text())[1].split()
    make = subprocess.run(
        ["make", "--dry-run", *targets], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    runs = re.findall(r"-m pytest -n 2 --dist worksteal(.*)", make.stdout)
    assert runs == ["", ' -m "long and not extended and not full"']
    assert sorted(LEFT_OUT) == ["extended", "full", "long"]


@pytest.mark.parametrize("command", [("check",), ("format", "--check")], ids=" ".join)
def test_style_and_layout_are_ruffs(command):
    """Of the whole repository, as pyproject.toml asks for."""
    pytest.importorskip("ruff", reason="ruff is not installed: pip install 'mis-integrators[lint]'")
    result = subprocess.run(
        [sys.executable, "-m", "ruff", *command, "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 0, result.stdout


def test_type_hints_are_right(tmp_path):
    """Those of the modules that pyproject.toml lists."""
    pytest.importorskip("mypy", reason="mypy is not installed: pip install 'mis-integrators[lint]'")
    result = subprocess.run(
        [sys.executable, "-m", "mypy", "--cache-dir", tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built without isolation: it needs no network, but a recent setuptools, which extra `test`
    brings."""
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip("setuptools is older than pyproject.toml asks for")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "mis_integrators", source / "mis_integrators")
    for name in ("pyproject.toml", "README.md", "LICENSE", "mis_render.py"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--wheel-dir",
            folder,
            source,
        ],
        check=True,
        timeout=300,
    )
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_every_file(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {file.relative_to(ROOT).as_posix() for file in package_files()} | {
        "mis_render.py"
    } <= names
    (entry_points,) = [name for name in names if name.endswith("entry_points.txt")]
    assert "mis-render = mis_render:main" in zipfile.ZipFile(wheel).read(entry_points).decode()
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert "mis_integrators/py.typed" in names


@pytest.mark.extended
def test_wheel_renders_without_the_checkout(wheel, tmp_path):
    """Installed into an environment of its own, which has nothing of this checkout: the command
    renders, and the doctor finds nothing wrong. Dependencies are those of this environment, so that
    it needs no network."""
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True, timeout=100)
    programs = tmp_path / "venv" / "bin"
    (packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    # Python reads no .pth files of folders that a .pth file names: not that of an editable install.
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}

    def run(*command) -> str:
        result = subprocess.run(
            [*map(str, command)],
            cwd=tmp_path,
            env=clean,
            capture_output=True,
            text=True,
            timeout=200,
        )
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout

    run(programs / "python", "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", wheel)
    where = (
        "import mis_integrators, mis_render; print(mis_integrators.__file__, mis_render.__file__)"
    )
    assert run(programs / "python", "-c", where).count(str(packages)) == 2
    shutil.copy(ROOT / "scenes" / "cornell_point.xml", tmp_path / "scene.xml")
    small = "-D", "resx=16", "-D", "resy=16", "--spp", 1, "--quiet"
    run(programs / "mis-render", "scene.xml", "-i", "bdpm", *small)
    assert (tmp_path / "scene.exr").exists() and (tmp_path / "scene.png").exists()
    run(programs / "python", "-m", "mis_integrators", "doctor")
