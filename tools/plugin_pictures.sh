#!/usr/bin/env bash
# plugin_pictures.sh [SECONDS]: render docs/images/plugins/NAME.png, a picture for the page of each plugin, SECONDS (20) each.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3} seconds=${1:-20} out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

picture() { # NAME SCENE [OPTION...]
    local name=$1 scene=$2
    shift 2
    "$python" -m mis_integrators render "scenes/$scene.xml" -o "$out/$name.exr" --time "$seconds" --quiet "$@"
    cp "$out/$name.png" docs/images/plugins/
}

mkdir -p docs/images/plugins
small="-D resx=200 -D resy=200"
picture bdpm_auto door $small -i bdpm_auto
picture bdpm caustics $small -i bdpm -P bdd=0
picture bdpm_media media/fog_caustic $small -i bdpm -P bdd=0
picture bdpm_opt cornell_glossy $small -i bdpm_opt3
picture bdpm_balance cornell_glossy $small -i bdpm_balance
picture bdpt door $small -i bdpt
picture vcm sds $small -i vcm
picture pcbpt cornell_area $small -i pcbpt -P light_paths=800
picture bdpt_ris cornell_area $small -i bdpt_ris -P light_paths=800
picture volpath_multiview multiview/smoke_orbit --all-views
