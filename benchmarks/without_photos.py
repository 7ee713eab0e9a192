"""Language with and without photos: scenes of the same splats, measured on the held-out photos of one capture.

    lexsplat build second --output photos
    cp photos/gaussians.ply splats.ply
    lexsplat language --splats splats.ply --output chosen --clip bundled --dino bundled --codebook.num-codes 256
    python benchmarks/without_photos.py photos chosen

The first scene was built from a capture with ground truth. The others have views that were chosen from the splats
alone; their thresholds come from these views.
"""

from __future__ import annotations

from pathlib import Path

from records import argument_parser, write_record

from lexsplat.evaluation.measuring import EvaluationConfig, evaluate
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import open_scene


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("photos", type=Path, help="scene built from a capture with ground truth")
    parser.add_argument("scenes", type=Path, nargs="*", help="scenes of the same splats, in the same axes")
    options = parser.parse_args()
    capture = reload_capture(SceneFolder.open(options.photos))
    rows = []
    for path in (options.photos, *options.scenes):
        scene = open_scene(path)
        metrics = evaluate(capture, scene, EvaluationConfig(lpips=False, protocols=("strict",)))
        strict = metrics.to_json()["language"]["strict"]
        views = SceneFolder.open(path).record["stages"].get("views", {})
        rows.append({"scene": path.name, "mIoU": strict["auto"]["mIoU"], "mAP": strict["mAP"], **views})
        print("{scene:24} mIoU {mIoU:.3f}  mAP {mAP:.3f}".format(**rows[-1]), flush=True)
    write_record(options.json, rows)


if __name__ == "__main__":
    main()
