"""Open a scene, ask for things, write heatmaps.

python examples/02_search_a_scene.py output/demo "red apple" "blue mug"
"""

import sys
from pathlib import Path

from PIL import Image

import lexsplat
from lexsplat.queries.heatmaps import overlay_heatmap

folder, prompts = Path(sys.argv[1]), sys.argv[2:] or ["red apple", "blue mug"]
scene = lexsplat.open_scene(folder)

# A view that was not trained on. Any camera of your own works as well.
view = next((name for name, view in scene.views.items() if view.split == "test"), next(iter(scene.views)))
picture = scene.render(view).image.clamp(0, 1).cpu().numpy()
relevancy = scene.relevancy(prompts, view).cpu().numpy()  # [P, H, W] in 0..1
thresholds = scene.thresholds(prompts).tolist()  # chosen from the scene alone, never from the ground truth

for prompt, heat, threshold in zip(prompts, relevancy, thresholds):
    share = (heat >= threshold).mean()
    print(f"{prompt}: at most {heat.max():.2f}, {share:.1%} of the picture above {threshold:.2f}")
    path = folder / "heatmaps" / f"{prompt.replace(' ', '_')}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(overlay_heatmap(picture, heat)).save(path)
