"""Check the glTF export with other programs: Babylon.js and the Khronos glTF validator.

python tools/check_exports.py SCENE FOLDER

Needs node 22 and npm; the tools are installed into FOLDER/node. Prints a line for each file; exit status 1 if one is
wrong. Babylon.js reads KHR_gaussian_splatting: its loader's Gaussians are compared one by one with the scene's. The
other formats are compared with splat-transform by tests/scenes/test_splat_transform.py.

The validator (gltf-validator 2.0.0-dev.3.10, the newest on npm when this was written) does not know
KHR_gaussian_splatting yet: it reports the names of the extension's attributes (with a colon, as the ratified text
wants them) as MESH_PRIMITIVE_INVALID_ATTRIBUTE, for splat-transform's own .glb as well. Those are counted apart;
anything else fails.
"""

import json
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
    export_scene(scene, folder / "language.glb", language=True)
    theirs = folder / "theirs.glb"
    program = (node / "node_modules" / ".bin" / "splat-transform").resolve()
    subprocess.run([program, "-q", "-w", reference.resolve(), theirs.resolve()], check=True)
    for name in ("language.glb", "theirs.glb"):
        wrong += report(name, validate(node, folder / name, len(scene.gaussians)))
    wrong += report("language.glb in Babylon.js", babylon(node, folder / "language.glb", scene.gaussians))
    return 1 if wrong else 0


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
