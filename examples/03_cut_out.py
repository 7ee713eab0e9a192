"""Select a thing by words, measure it, and save it as a splat file.

python examples/03_cut_out.py [SCENE [PHRASE [OUTPUT]]]    the ending of OUTPUT is its format: .ply, .spz, .glb, ...
"""

import sys
from pathlib import Path

import lexsplat
from lexsplat.scenes.exporting import export_gaussians

folder = sys.argv[1] if len(sys.argv) > 1 else "demo"
phrase = sys.argv[2] if len(sys.argv) > 2 else "red apple"
output = Path(sys.argv[3] if len(sys.argv) > 3 else "output/examples/cut_out.ply")

scene = lexsplat.open_scene(folder)
found = scene.select(phrase)  # scene.find(phrase) also understands relations, such as "mug left of the duck"
if not found.instances:
    sys.exit(f"{phrase!r} selects nothing (present: {found.present})")

for thing in found.instances:
    center, size = thing.center.round(2).tolist(), thing.size.round(2).tolist()
    print(f"{phrase}: {len(thing)} Gaussians around {center}, size {size} in units of the scene")

output.parent.mkdir(parents=True, exist_ok=True)
export_gaussians(found.selected, output, world=scene.world, overwrite=True)
print(f"{len(found)} of {len(scene.gaussians)} Gaussians: {output}")
