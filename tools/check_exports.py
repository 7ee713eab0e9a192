"""Check exports with other programs: splat-transform, Babylon.js and the Khronos glTF validator.

python tools/check_exports.py SCENE FOLDER

Needs node and npm; the tools are installed into FOLDER/node. Writes every format into FOLDER, compares counts and
values, and prints a line for each file; exit status 1 if one is wrong. Babylon.js reads KHR_gaussian_splatting: its
loader's Gaussians are compared one by one with the scene's.

The validator (gltf-validator 2.0.0-dev.3.10, the newest on npm when this was written) does not know
KHR_gaussian_splatting yet: it reports the names of the extension's attributes (with a colon, as the ratified text
wants them) as MESH_PRIMITIVE_INVALID_ATTRIBUTE, for splat-transform's own .glb as well. Those are counted apart;
anything else fails.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.scenes.exporting import export_scene
from lexsplat.scenes.scene import open_scene

VALIDATE = """
import validator from 'gltf-validator'; import fs from 'fs';
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 0});
console.log(JSON.stringify(report));
"""
BABYLON = """
globalThis.Worker = class { postMessage() {} terminate() {} };  // sorts for drawing, which is not asked for here
const { NullEngine } = await import('@babylonjs/core/Engines/nullEngine.js');
const { Scene } = await import('@babylonjs/core/scene.js');
const { LoadAssetContainerAsync } = await import('@babylonjs/core/Loading/sceneLoader.js');
const { GaussianSplattingMesh } = await import('@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js');
await import('@babylonjs/loaders/glTF/index.js');
const fs = await import('fs');
const [file, output] = process.argv.slice(2);
GaussianSplattingMesh.prototype.updateDataAsync = async (splats) => fs.writeFileSync(output, new Uint8Array(splats));
const content = new Uint8Array(fs.readFileSync(file));
await LoadAssetContainerAsync(content, new Scene(new NullEngine()), { pluginExtension: '.glb' });
"""
BABYLON_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
SPLATS = ("ply", "splat", "spz", "compressed.ply", "ksplat")
COLUMNS = ("x", "y", "z", "f_dc_0", "scale_0", "opacity")


def main() -> int:
    scene, folder = open_scene(sys.argv[1]), Path(sys.argv[2])
    node = folder / "node"
    node.mkdir(parents=True, exist_ok=True)
    (node / "package.json").write_text('{"private": true, "type": "module"}')
    packages = ["@playcanvas/splat-transform", "gltf-validator", "@babylonjs/core", "@babylonjs/loaders"]
    install = ["npm", "install", "--silent", *packages]
    subprocess.run(install, cwd=node, check=True)
    (node / "validate.js").write_text(VALIDATE)
    (node / "babylon.js").write_text(BABYLON)
    wrong = 0
    (reference,) = export_scene(scene, folder / "all.ply")
    expected = summary(node, reference)
    for ending in SPLATS:
        export_scene(scene, folder / f"all.{ending}")
        wrong += report(f"all.{ending}", compare(expected, summary(node, folder / f"all.{ending}")))
    export_scene(scene, folder / "language.ply", language=True)
    wrong += report("language.ply", compare(expected, summary(node, folder / "language.ply")))
    export_scene(scene, folder / "language.glb", language=True)
    theirs = folder / "theirs.glb"
    subprocess.run([*transform(node), "-w", reference.resolve(), theirs.resolve()], check=True)
    for name in ("language.glb", "theirs.glb"):
        wrong += report(name, validate(node, folder / name, len(scene.gaussians)))
    wrong += report("language.glb in Babylon.js", babylon(node, folder / "language.glb", scene.gaussians))
    return 1 if wrong else 0


def transform(node: Path) -> list[str]:
    return [str((node / "node_modules" / ".bin" / "splat-transform").resolve()), "-q"]


def summary(node: Path, file: Path) -> dict[str, list[float]]:
    """Count, and minimum, maximum and median of the columns, read by splat-transform."""
    # By way of a PLY: every format has its own axes in the file, and the program knows them.
    plain = file.with_name(f"{file.name}.theirs.ply").resolve()
    subprocess.run([*transform(node), "-w", str(file.resolve()), str(plain)], check=True)
    command = [*transform(node), str(plain), "-m", "null"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = {"count": [float(re.search(r"Row Count:\*\* (\d+)", text)[1])]}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > 5 and cells[1] in COLUMNS:
            found[cells[1]] = [float(value) for value in cells[2:5]]
    return found


def compare(expected: dict, found: dict) -> list[str]:
    """Differences larger than 8-bit rounding and clipped logits explain."""
    problems = [] if found["count"] == expected["count"] else [f"count {found['count']}"]
    for column in COLUMNS:
        median, other = expected[column][2], found[column][2]
        # Opacity has few steps near 1 in logits; splat-transform shows it activated.
        limit = 0.15 if column == "opacity" else 0.02 * max(1.0, abs(median))
        if abs(median - other) > limit:
            problems.append(f"median of {column} {other:g} instead of {median:g}")
    return problems


def validate(node: Path, file: Path, count: int) -> list[str]:
    command = ["node", "validate.js", str(file.resolve())]
    text = subprocess.run(command, cwd=node, check=True, capture_output=True, text=True).stdout
    answer = json.loads(text)
    unknown = "KHR_gaussian_splatting:"
    known = [m for m in answer["issues"]["messages"] if unknown in m["pointer"]]
    others = [m for m in answer["issues"]["messages"] if m["severity"] <= 1 and unknown not in m["pointer"]]
    told = f"{answer['validatorVersion']}: {len(known)} attribute names of the extension unknown to it"
    print(f"  {file.name}: validator {told}, {len(others)} other errors and warnings")
    problems = [f"{m['code']} at {m['pointer']}" for m in others]
    if answer["info"]["totalVertexCount"] != count:
        problems.append(f"{answer['info']['totalVertexCount']} vertices instead of {count}")
    return problems


def babylon(node: Path, file: Path, gaussians: Gaussians) -> list[str]:
    """Differences in Babylon.js: floats must be equal, 8-bit colors and rotations within a step."""
    output = file.with_name(f"{file.name}.babylon").resolve()
    subprocess.run(["node", "babylon.js", str(file.resolve()), str(output)], cwd=node, check=True)
    found = np.fromfile(output, BABYLON_SPLAT)
    if len(found) != len(gaussians):
        return [f"{len(found)} Gaussians instead of {len(gaussians)}"]
    colors = (0.5 + SH_C0 * gaussians.sh0[:, 0]).clamp(0, 1)
    rgba = torch.cat([colors, gaussians.opacities[:, None]], 1) * 255
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1) * 127.5 + 127.5
    pairs = {
        "mean": (gaussians.means, 1e-6), "scale": (gaussians.scales, 1e-6), "rgba": (rgba, 1.0), "quat": (quats, 1.0),
    }  # fmt: skip
    problems = []
    for name, (expected, limit) in pairs.items():
        off = np.abs(found[name] - expected.numpy()).max()
        if not off <= limit:
            problems.append(f"{name} differs by {off:g}")
    return problems


def report(name: str, problems: list[str]) -> int:
    print(f"{name}: {'; '.join(problems) or 'right'}")
    return len(problems)


sys.exit(main())
