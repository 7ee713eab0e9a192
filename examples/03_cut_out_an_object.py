"""Select Gaussians by words and save them as a splat file.

python examples/03_cut_out_an_object.py output/demo "red apple" apple.ply
"""

import sys
from pathlib import Path

import lexsplat
from lexsplat.scenes.formats.ply import write_ply

folder, prompt, output = sys.argv[1], sys.argv[2], Path(sys.argv[3])
scene = lexsplat.open_scene(folder)

scores = scene.scores([prompt])[0]  # [N] in 0..1
threshold = float(scene.thresholds([prompt])[0])
chosen = scene.gaussians.select(scores >= threshold)
if len(chosen) == 0:
    sys.exit(f"no Gaussian answers to {prompt!r} above {threshold:.2f}")

# The median is where the thing is, even if a few floaters answer too.
center = chosen.means.median(dim=0).values.tolist()
print(f"{prompt}: {len(chosen)} of {len(scene.gaussians)} Gaussians around {[round(c, 2) for c in center]}")
write_ply(chosen, output)
