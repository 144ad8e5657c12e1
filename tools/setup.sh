#!/usr/bin/env bash
# setup.sh PYTHON VENV: make a virtual environment, after installing with apt what the system lacks for it (a
# libLLVM that works with Dr.Jit, Python's venv module). Says what it installs before it does, and stops with one
# message where that is not possible. With NO_APT=1 it installs nothing, but says what to install, and stops.
set -euo pipefail
python=$1 venv=$2
cd "$(dirname "$0")/.."

# Seconds to wait for another apt to finish, such as the system's own updates.
lock_seconds=300

stop() { echo "setup: $*" >&2; exit 1; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

can_install() {
    command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }
}

# The lock of the package lists is not one that apt itself waits for.
update_packages() {
    local message waited=0
    until message=$(as_root env LC_ALL=C apt-get update -qq </dev/null 2>&1); do
        [[ $message == *"get lock"* && $waited -lt $lock_seconds ]] || stop "apt-get update failed: ${message##*$'\n'}"
        sleep 5
        waited=$((waited + 5))
    done
}

# install_package NAME REASON: of the reason only that is said before.
install_package() {
    echo "setup: $2; as root: apt-get install $1 (NO_APT=1 keeps this from being done)"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq -o "DPkg::Lock::Timeout=$lock_seconds" "$1" </dev/null >/dev/null ||
        stop "apt-get could not install $1"
}

# The newest libLLVM package that apt knows of the versions that are tested, such as libllvm19 or libllvm17t64.
newest_llvm_package() {
    apt-cache pkgnames libllvm | sed -nE 's/^libllvm([0-9]+)(t64)?$/\1 &/p' | sort -n |
        awk -v oldest="$oldest" -v newest="$newest" '$1 >= oldest && $1 <= newest {name = $2} END {print name}'
}

version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) ||
    stop "$python does not run; install Python 3.10 or newer, or name one: make PYTHON=python3.11"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
    stop "$python is Python $version; name Python 3.10 or newer: make PYTHON=python3.11"
read -r oldest newest < <("$python" mis_integrators/llvm.py versions)

if ! message=$("$python" mis_integrators/llvm.py 2>&1); then
    # What the message tells to do is all that can be said where a library was named, or apt cannot or shall not be used.
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && [ -z "${NO_APT:-}" ] && can_install || stop "$message"
    echo "setup: no LLVM from $oldest to $newest on this system; as root: apt-get update (NO_APT=1 keeps this from being done)"
    update_packages
    package=$(newest_llvm_package)
    [ -n "$package" ] || stop "$message (apt knows no such package here)"
    install_package "$package" "Dr.Jit needs LLVM"
    message=$("$python" mis_integrators/llvm.py 2>&1) || stop "$message"
fi

if [ ! -x "$venv/bin/pip" ]; then
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        [ -z "${NO_APT:-}" ] && can_install || stop "Python's venv module is missing: apt-get install python$version-venv (Debian, Ubuntu)"
        echo "setup: $python has no module venv; as root: apt-get update (NO_APT=1 keeps this from being done)"
        update_packages
        install_package "python$version-venv" "the virtual environment needs it"
    fi
    "$python" -m venv --clear "$venv" || stop "could not make the virtual environment $venv"
fi
