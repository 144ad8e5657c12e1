#!/usr/bin/env bash
# hero.sh [SECONDS [REFERENCE_SECONDS]]: render the pictures of README.md, SECONDS (240) each image, all of them also denoised:
# docs/images/still_life.jpg, by path and by bdpm_auto, with their errors against a reference that is kept in out/hero;
# docs/images/shafts.jpg, by volpath and by bdpm_auto, for half as long.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3} seconds=${1:-240} reference_seconds=${2:-600} out=out/hero scenes=scenes/gallery
mkdir -p "$out"

compared() { # NAME OTHER SECONDS [OPTION...]
    local name=$1 other=$2 time=$3
    shift 3
    "$python" -m mis_integrators render "$scenes/$name.xml" -i bdpm_auto --compare "$other" --denoise --time "$time" \
        -o "$out/$name.exr" "$@"
    "$python" tools/as_jpeg.py "$out/$name.compare.png" "docs/images/$name.jpg"
}

# Photons within a distance of two pixels: path does not converge on caustics, seen through glass or not.
if [ ! "$out/reference.exr" -nt "$scenes/still_life.xml" ]; then
    "$python" -m mis_integrators render "$scenes/still_life.xml" -i bdpm -P bdd=0 -P initial_radius=0.008 -P photon_count=1000000 \
        --seed 77 --time "$reference_seconds" -o "$out/new.exr"
    mv "$out/new.exr" "$out/reference.exr"
fi
compared still_life path "$seconds" --reference "$out/reference.exr"
compared shafts volpath "$((seconds / 2))"
