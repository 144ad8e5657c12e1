"""as_jpeg.py IMAGE JPEG: writes an image file as a small JPEG for the documentation."""

import sys

from PIL import Image

source, target = sys.argv[1:]
Image.open(source).convert("RGB").save(target, quality=88, optimize=True, progressive=True)
