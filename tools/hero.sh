#!/usr/bin/env bash
# hero.sh [SECONDS [REFERENCE_SECONDS]]: render docs/images/still_life.jpg, the picture of README.md: a still life by path and by
# bdpm_auto, SECONDS (240) each, both also denoised, with their errors against a reference. The reference is kept in out/hero.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3} seconds=${1:-240} reference_seconds=${2:-600} out=out/hero scene=scenes/gallery/still_life.xml
mkdir -p "$out"

# Photons within a distance of two pixels: path does not converge on caustics, seen through glass or not.
if [ ! "$out/reference.exr" -nt "$scene" ]; then
    "$python" -m mis_integrators render "$scene" -i bdpm -P bdd=0 -P initial_radius=0.008 -P photon_count=1000000 \
        --seed 77 --time "$reference_seconds" -o "$out/new.exr"
    mv "$out/new.exr" "$out/reference.exr"
fi
"$python" -m mis_integrators render "$scene" -i bdpm_auto --compare path --denoise --time "$seconds" \
    --reference "$out/reference.exr" -o "$out/still_life.exr"
"$python" -c "
import sys
from PIL import Image
picture = Image.open(sys.argv[1]).convert('RGB')
picture.save(sys.argv[2], quality=88, optimize=True, progressive=True)
" "$out/still_life.compare.png" docs/images/still_life.jpg
