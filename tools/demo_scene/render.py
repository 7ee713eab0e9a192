"""Build a layout in Blender and render images, object indices and depths.

Written to a work folder:

    cameras.json       width, height, K, and camera-to-world (OpenGL axes) of each view
    things.json        what the object indices mean
    images/NAME.png    8-bit RGB
    truth/NAME.npz     index uint8 [H, W] (0 = nothing), depth float32 [H, W] along the viewing axis
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from layouts import Layout
from mathutils import Matrix
from numpy.typing import NDArray
from surroundings import light_room, make_cloth, make_floor, make_table, make_wall
from things import Thing, make


def build(layout: Layout, without: str | None = None) -> list[Thing]:
    """Fill an empty Blender file with the layout, but for the objects of one kind.

    Each object has its own random generator, so that the others do not depend on which are there.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    number = 0

    def next_thing() -> tuple[int, np.random.Generator]:
        nonlocal number
        number += 1
        return number, np.random.default_rng([layout.seed, number])

    things = []
    for place in layout.placements:
        thing = make(place.kind, place.color, *next_thing())
        thing.place(place.x, place.y, place.z, place.turn, place.scale)
        if place.kind == without:
            for each in thing.objects:
                bpy.data.objects.remove(each)
            continue
        things.append(thing)
    things.append(make_table(*next_thing()))
    color, x, y, turn = layout.cloth
    things.append(make_cloth(color, *next_thing(), x, y, turn))
    things.append(make_wall(*layout.wall, *next_thing()))
    things.append(make_floor(*next_thing()))
    light_room(*layout.key_light, layout.fill_watts, layout.sky)
    return things


def set_up(layout: Layout, scratch: Path, threads: int) -> None:
    """Cycles on the CPU, a camera, and the index and depth passes written to ``scratch``."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.angle = "HORIZONTAL", math.radians(layout.field_of_view)
    scene.camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(scene.camera)

    render = scene.render
    render.engine, render.use_persistent_data = "CYCLES", True
    render.threads_mode, render.threads = "FIXED", threads
    render.resolution_x, render.resolution_y, render.resolution_percentage = layout.width, layout.height, 100
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"

    layer = scene.view_layers[0]
    layer.use_pass_object_index = layer.use_pass_z = True
    scene.use_nodes = True
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()
    layers, composite = nodes.new("CompositorNodeRLayers"), nodes.new("CompositorNodeComposite")
    links.new(layers.outputs["Image"], composite.inputs["Image"])
    files = nodes.new("CompositorNodeOutputFile")
    files.base_path = str(scratch)
    files.format.file_format, files.format.color_depth = "OPEN_EXR", "32"
    files.file_slots.clear()
    for slot, output in (("index", "IndexOB"), ("depth", "Depth")):
        files.file_slots.new(slot)
        links.new(layers.outputs[output], files.inputs[slot])


def use_image_quality(samples: int) -> None:
    """Path tracing with denoising."""
    cycles = bpy.context.scene.cycles
    cycles.device, cycles.samples = "CPU", samples
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, 0.02
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.denoising_input_passes, cycles.denoising_quality = "RGB_ALBEDO_NORMAL", "HIGH"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 6, 3, 3
    cycles.sample_clamp_indirect = 4
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5


def use_truth_quality() -> None:
    """One ray through the center of every pixel, so that indices and depths are exact there."""
    cycles = bpy.context.scene.cycles
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = 1, False, False
    cycles.max_bounces = 0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 0.01


def shoot(pose: NDArray, picture: Path) -> None:
    """Renders from ``pose`` (camera to world, OpenGL axes)."""
    scene = bpy.context.scene
    scene.camera.matrix_world = Matrix(pose.tolist())
    scene.render.filepath = str(picture)
    bpy.ops.render.render(write_still=True)


def read_pass(path: Path) -> NDArray[np.float32]:
    """A one-channel image ``[H, W]``, top row first (Blender stores the bottom row first)."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, -1)[::-1, :, 0].copy()


def intrinsics(layout: Layout) -> list[list[float]]:
    focal = layout.width / 2 / math.tan(math.radians(layout.field_of_view) / 2)
    return [[focal, 0, layout.width / 2], [0, focal, layout.height / 2], [0, 0, 1]]


def render(
    layout: Layout,
    work: Path,
    *,
    samples: int,
    threads: int,
    say: Callable[[str], None],
    every: int = 1,
    without: str | None = None,
) -> None:
    """Render the layout into ``work``; existing views are kept.

    Args:
        layout: The scene.
        work: Work folder, made if needed.
        samples: Paths a pixel at most.
        threads: Threads of the renderer.
        say: Takes a line of progress (Blender floods standard output).
        every: Only every so many views, to have a look.
        without: A kind of object that is left out; then only images of the held-out views are made.
    """
    things = build(layout, without)
    scratch = work / "scratch"
    set_up(layout, scratch, threads)
    for folder in (scratch, work / "images", work / "truth"):
        folder.mkdir(parents=True, exist_ok=True)
    poses = layout.path.poses(layout.views)
    views = {name: pose.tolist() for name, pose in zip(layout.names(), poses)}
    cameras = {
        "width": layout.width,
        "height": layout.height,
        "K": intrinsics(layout),
        "camera_to_world": views,
    }
    (work / "cameras.json").write_text(json.dumps(cameras, indent=1))
    meaning = {t.number: {"kind": t.kind, "color": t.color, "parts": t.parts} for t in things}
    (work / "things.json").write_text(json.dumps(meaning, indent=1))

    chosen = list(zip(layout.names(), poses))[::every]
    if without:
        chosen = [(name, pose) for name, pose in chosen if name in layout.test_names()]
    use_truth_quality()
    for name, pose in () if without else chosen:
        if not (work / "truth" / f"{name}.npz").exists():
            shoot(pose, scratch / "discarded.png")
            index = np.rint(read_pass(scratch / "index0001.exr")).astype(np.uint8)
            depth = read_pass(scratch / "depth0001.exr")
            np.savez_compressed(work / "truth" / f"{name}.npz", index=index, depth=depth)
    use_image_quality(samples)
    for done, (name, pose) in enumerate(chosen, 1):
        picture = work / "images" / f"{name}.png"
        if not picture.exists():
            start = time.perf_counter()
            bpy.context.scene.cycles.seed = int(name.rsplit("_", 1)[1])
            shoot(pose, scratch / "picture.png")
            (scratch / "picture.png").rename(picture)
            say(f"{name} ({done} of {len(chosen)}): {time.perf_counter() - start:.1f} s")
