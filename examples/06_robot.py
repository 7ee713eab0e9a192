"""A robot that asks where things are, ten times a second, while it moves.

    python examples/06_robot.py [SCENE [PHRASE ...]]

SCENE is a folder that `lexsplat build` made, or the word "demo" for the scene that ships with lexsplat. "Left" and
"closest to me" refer to the robot's own camera.
"""

import sys
import time

import numpy as np

import lexsplat
from lexsplat.geometry.cameras import look_at

folder = sys.argv[1] if len(sys.argv) > 1 else "demo"
phrases = sys.argv[2:] or ["red apple", "fruit closest to me", "what is left of the vase?"]

scene = lexsplat.open_scene(folder)
up = scene.world.up.direction
path = [camera.position for camera in scene.cameras.values()][:20]
target = np.mean([scene.find(phrases[0]).center, scene.gaussians.means.mean(0).numpy()], axis=0)
for phrase in phrases:  # the first time a word is asked, its scores are computed
    scene.find(phrase)

late = 0
for number, position in enumerate(path):
    due = time.perf_counter() + 0.1
    camera = look_at(position, target, up, 320, 240, 0.8)
    phrase = phrases[number % len(phrases)]
    started = time.perf_counter()
    found = scene.find(phrase, camera)
    took = 1e3 * (time.perf_counter() - started)
    places = ", ".join(f"{thing.phrase} at {np.round(thing.center, 2)}" for thing in found.instances)
    print(f"{number}: {phrase}: {found.present}: {places or 'nothing'} ({took:.1f} ms)")
    late += time.perf_counter() > due
    time.sleep(max(0.0, due - time.perf_counter()))
print(f"{late} of {len(path)} answers were late")
