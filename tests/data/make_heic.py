"""Makes quadrants.heic, which `test_heic_photos_are_read` reads: ``pip install pillow-heif; python make_heic.py``.

The library that reads HEIC for us (pi-heif) writes none; the one that does carries an encoder under the GPL, so it is
needed for making this file only.
"""

from pathlib import Path

import numpy as np
import pillow_heif
from PIL import Image

pillow_heif.register_heif_opener()
quadrants = np.zeros((32, 48, 3), np.uint8)
quadrants[:16, :24], quadrants[:16, 24:] = (220, 40, 40), (40, 200, 60)
quadrants[16:, :24], quadrants[16:, 24:] = (50, 60, 210), (230, 220, 90)
Image.fromarray(quadrants).save(Path(__file__).with_name("quadrants.heic"), format="HEIF", quality=95)
