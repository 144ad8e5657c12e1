#!/usr/bin/env bash
# setup.sh PYTHON VENV: make a virtual environment, after installing with apt what the system lacks for it (a
# libLLVM that works with Dr.Jit, Python's venv module). Stops with one message where that is not possible.
set -euo pipefail
python=$1 venv=$2
cd "$(dirname "$0")/.."

stop() { echo "setup: $*" >&2; exit 1; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

can_install() {
    command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }
}

update_packages() {
    as_root apt-get update -qq </dev/null || stop "apt-get update failed"
}

install_package() {
    echo "setup: installing $1"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$1" </dev/null >/dev/null ||
        stop "apt-get could not install $1"
}

# The newest libLLVM package (17 or later) that apt knows, such as libllvm19 or libllvm17t64.
newest_llvm_package() {
    apt-cache pkgnames libllvm | sed -nE 's/^libllvm([0-9]+)(t64)?$/\1 &/p' | sort -n |
        awk '$1 >= 17 {name = $2} END {print name}'
}

version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) ||
    stop "$python does not run; install Python 3.10 or newer, or name one: make PYTHON=python3.11"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
    stop "$python is Python $version; name Python 3.10 or newer: make PYTHON=python3.11"

if ! message=$("$python" mis_integrators/llvm.py 2>&1); then
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && can_install || stop "$message"
    update_packages
    package=$(newest_llvm_package)
    [ -n "$package" ] || stop "$message (apt knows no such package here)"
    install_package "$package"
    message=$("$python" mis_integrators/llvm.py 2>&1) || stop "$message"
fi

if [ ! -x "$venv/bin/pip" ]; then
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        can_install || stop "Python's venv module is missing: apt-get install python$version-venv"
        update_packages
        install_package "python$version-venv"
    fi
    "$python" -m venv --clear "$venv" || stop "could not make the virtual environment $venv"
fi
