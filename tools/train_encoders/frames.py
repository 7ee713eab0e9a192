"""Render random scenes to training frames. Needs Blender.

Written to a folder, for scene S and view V, every file whole or not at all:

    S.json      what the indices mean: {number: {kind, color, finish, parts: {name: part number}}}
    S_V.png     picture, 8-bit RGB
    S_V.npz     index uint8 [H, W]: 10 * number of the thing + number of the part; 0 is nothing

The last file of a scene is its JSON: a scene without one is made again.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from random_scenes import RandomScene, random_scene
from render import read_pass

WIDTH, HEIGHT = 320, 240


def render_frames(
    folder: Path, scenes: list[int], *, views: int, samples: int, threads: int, say: Callable[[str], None]
) -> None:
    """Render the scenes with these seeds; existing ones are kept.

    Args:
        folder: Made if needed. The name "unseen" asks for pairs of kind and color that training leaves out.
        scenes: Seeds.
        views: Pictures of each.
        samples: Paths a pixel; what they leave is denoised.
        threads: Threads of the renderer.
        say: Takes a line of progress.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scratch = folder / f"scratch_{os.getpid()}"
    start, made = time.perf_counter(), 0
    for seed in scenes:
        name = f"s{seed:06d}"
        if (folder / f"{name}.json").exists():
            continue
        bpy.ops.wm.read_factory_settings(use_empty=True)
        rng = np.random.default_rng(seed)
        scene = random_scene(rng, views, held_out=folder.name == "unseen")
        _set_up(scene, scratch, samples, threads)
        for view, pose in enumerate(scene.poses):
            bpy.context.scene.camera.matrix_world = Matrix(pose.tolist())
            bpy.context.scene.cycles.seed = int(rng.integers(1 << 30))
            bpy.context.scene.render.filepath = str(scratch / "picture.png")
            bpy.ops.render.render(write_still=True)
            index = np.rint(read_pass(scratch / "index0001.exr")).astype(np.uint8)
            np.savez_compressed(scratch / "index.npz", index=index)
            (scratch / "picture.png").replace(folder / f"{name}_{view}.png")
            (scratch / "index.npz").replace(folder / f"{name}_{view}.npz")
        meaning = {
            thing.number: {
                "kind": thing.kind,
                "color": thing.color,
                "finish": scene.finishes.get(thing.number),
                "parts": thing.parts,
            }
            for thing in scene.things
        }
        (scratch / "scene.json").write_text(json.dumps(meaning))
        (scratch / "scene.json").replace(folder / f"{name}.json")
        made += 1
        rate = (time.perf_counter() - start) / (made * views)
        if made % 10 == 0:
            say(f"{folder.name}: {made} of {len(scenes)} scenes, {rate:.2f} s a frame")


def _set_up(scene: RandomScene, scratch: Path, samples: int, threads: int) -> None:
    """Cycles with few samples and denoising, a camera, and the index pass written to ``scratch``."""
    blender = bpy.context.scene
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.angle = "HORIZONTAL", math.radians(scene.field_of_view)
    blender.camera = bpy.data.objects.new("camera", camera)
    blender.collection.objects.link(blender.camera)

    render, cycles = blender.render, blender.cycles
    render.engine, render.use_persistent_data = "CYCLES", True
    render.threads_mode, render.threads = "FIXED", threads
    render.resolution_x, render.resolution_y, render.resolution_percentage = WIDTH, HEIGHT, 100
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
    blender.view_settings.view_transform = "AgX"
    blender.view_settings.look = "AgX - Medium High Contrast"
    blender.view_settings.exposure = scene.exposure
    cycles.device, cycles.samples, cycles.use_adaptive_sampling = "CPU", samples, False
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.denoising_input_passes, cycles.denoising_quality = "RGB_ALBEDO_NORMAL", "FAST"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 4, 2, 2
    cycles.sample_clamp_indirect = 3
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5

    blender.view_layers[0].use_pass_object_index = True
    blender.use_nodes = True
    nodes, links = blender.node_tree.nodes, blender.node_tree.links
    nodes.clear()
    layers, composite = nodes.new("CompositorNodeRLayers"), nodes.new("CompositorNodeComposite")
    links.new(layers.outputs["Image"], composite.inputs["Image"])
    files = nodes.new("CompositorNodeOutputFile")
    files.base_path = str(scratch)
    files.format.file_format, files.format.color_depth = "OPEN_EXR", "32"
    files.file_slots.clear()
    files.file_slots.new("index")
    links.new(layers.outputs["IndexOB"], files.inputs["index"])
