#!/usr/bin/env bash
# gallery.sh [NAME...]: render the pictures of docs/gallery.md (or those named) by the commands of that page, into docs/images/gallery.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
mkdir -p docs/images/gallery out

grep '^    mis-render ' docs/gallery.md | while read -r _ arguments; do
    name=$(basename "${arguments##*-o }" .exr)
    [ $# -eq 0 ] || [[ " $* " == *" $name "* ]] || continue
    # shellcheck disable=SC2086  # the arguments are words
    "$python" -m mis_integrators render $arguments --seed 1 </dev/null
    "$python" tools/as_jpeg.py "out/$name.denoised.png" "docs/images/gallery/$name.jpg"
done
