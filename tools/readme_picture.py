"""Make the image at the top of the README: a rendering and the relevancy of a few prompts, side by side.

python tools/readme_picture.py output/demo view_033 docs/images/queries.jpg \\
    "red apple" "blue mug" "something made of metal" "bear nose" "checkered cloth"
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import lexsplat
from lexsplat.queries.heatmaps import overlay_heatmap

WIDTH = 360


def main() -> None:
    folder, view, output, prompts = sys.argv[1], sys.argv[2], Path(sys.argv[3]), sys.argv[4:]
    scene = lexsplat.open_scene(folder)
    camera = scene.view(view).camera.resized(480, 360)
    image = scene.render(camera).image.clamp(0, 1).cpu().numpy()
    tiles = [("rendering of a held-out view", (image * 255).astype(np.uint8))]
    for prompt, relevancy in zip(prompts, scene.relevancy(prompts, camera).cpu().numpy()):
        tiles.append((f"\u201c{prompt}\u201d", overlay_heatmap(image, relevancy)))
    font = ImageFont.load_default(size=16)
    height = WIDTH * image.shape[0] // image.shape[1]
    columns = 3
    rows = -(-len(tiles) // columns)
    sheet = Image.new("RGB", (columns * (WIDTH + 8) - 8, rows * (height + 34) - 4), "white")
    for number, (title, pixels) in enumerate(tiles):
        x, y = number % columns * (WIDTH + 8), number // columns * (height + 34)
        sheet.paste(Image.fromarray(pixels).resize((WIDTH, height), Image.Resampling.LANCZOS), (x, y))
        ImageDraw.Draw(sheet).text((x + 4, y + height + 4), title, fill=(40, 40, 40), font=font)
    output.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(output, quality=88, optimize=True)


if __name__ == "__main__":
    main()
