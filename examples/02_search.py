"""Search a scene with words, and draw heatmaps.

    python examples/02_search.py [SCENE [PROMPT ...]]

SCENE is a folder that `lexsplat build` made, or the word "demo" for the scene that ships with lexsplat.
"""

import sys
from pathlib import Path

from PIL import Image

import lexsplat
from lexsplat.queries.heatmaps import overlay_heatmap

folder = sys.argv[1] if len(sys.argv) > 1 else "demo"
prompts = sys.argv[2:] or ["red apple", "blue mug"]
output = Path("output/examples")
output.mkdir(parents=True, exist_ok=True)

scene = lexsplat.open_scene(folder)

# A view that was held out from the build. Any camera of your own works as well.
view = next((name for name, view in scene.views.items() if view.split == "test"), next(iter(scene.views)))
image = scene.render(view).image.clamp(0, 1).cpu().numpy()  # [H, W, 3]
relevancy = scene.relevancy(prompts, view).cpu().numpy()  # [P, H, W] in 0..1
thresholds = scene.thresholds(prompts).tolist()  # chosen from the scene alone, never from ground truth

for prompt, heat, threshold in zip(prompts, relevancy, thresholds):
    share = (heat >= threshold).mean()
    path = output / f"{prompt.replace(' ', '_')}.png"
    Image.fromarray(overlay_heatmap(image, heat)).save(path)
    print(f"{prompt}: best {heat.max():.2f}, {share:.1%} of the image above {threshold:.2f}, heatmap: {path}")
