"""Meshes from formulas: vertices ``[V, 3]`` and faces as tuples of vertex numbers. Needs numpy only.

Lengths are in scene units (about 20 cm each), z is up, and an object stands on z = 0 around the z axis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

TINY = 1e-4
"""Radius that stands for 0 at a pole, so that no face degenerates to a line."""


class Mesh(NamedTuple):
    """Vertices ``[V, 3]`` float64 and faces (counter-clockwise seen from outside, quads or polygons)."""

    vertices: NDArray[np.float64]
    faces: list[tuple[int, ...]]

    def moved(self, offset: ArrayLike) -> Mesh:
        return Mesh(self.vertices + np.asarray(offset, float), self.faces)

    def turned_about_x(self, angle: float) -> Mesh:
        c, s = np.cos(angle), np.sin(angle)
        return Mesh(self.vertices @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]), self.faces)

    def turned_about_z(self, angle: float) -> Mesh:
        c, s = np.cos(angle), np.sin(angle)
        return Mesh(self.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), self.faces)

    def tapered_above(self, height: float, factors: ArrayLike) -> Mesh:
        """The vertices above ``height`` scaled about the z axis (a box becomes a cabin)."""
        vertices = self.vertices.copy()
        vertices[vertices[:, 2] > height] *= np.asarray(factors, float)
        return Mesh(vertices, self.faces)


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes joined to one."""
    faces: list[tuple[int, ...]] = []
    start = 0
    for mesh in meshes:
        faces += [tuple(start + vertex for vertex in face) for face in mesh.faces]
        start += len(mesh.vertices)
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), faces)


def grid_quads(rows: int, columns: int, *, wrap: bool) -> list[tuple[int, ...]]:
    """Quads over ``rows x columns`` vertices in row-major order; ``wrap`` closes each row to a ring."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns if wrap else columns - 1), indexing="ij")
    left, right = i * columns + j, i * columns + (j + 1) % columns
    quads = np.stack([left, right, right + columns, left + columns], -1).reshape(-1, 4)
    return [tuple(quad) for quad in quads.tolist()]


def lathe(profile: ArrayLike, segments: int = 48, *, ribs: int = 0, rib_depth: float = 0.0) -> Mesh:
    """A surface of revolution: a profile of (radius, height) about the z axis, with ``ribs`` grooves (pumpkin)."""
    radius, height = np.asarray(profile, float).T
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    groove = 1 - rib_depth * np.abs(np.cos(angle * ribs / 2)) ** 6
    vertices = np.stack(
        [
            radius[:, None] * np.cos(angle) * groove,
            radius[:, None] * np.sin(angle) * groove,
            np.repeat(height[:, None], segments, 1),
        ],
        -1,
    )
    return Mesh(vertices.reshape(-1, 3), grid_quads(len(radius), segments, wrap=True))


def smooth_profile(points: ArrayLike, samples: int = 30) -> NDArray[np.float64]:
    """A Catmull-Rom curve through (radius, height) points, radii kept above 0."""
    knots = np.asarray(points, float)
    position = np.linspace(0, 1, samples) * (len(knots) - 1)
    segment = np.minimum(position.astype(int), len(knots) - 2)
    t = (position - segment)[:, None]
    before, start = knots[np.maximum(segment - 1, 0)], knots[segment]
    end, after = knots[segment + 1], knots[np.minimum(segment + 2, len(knots) - 1)]
    curve = 0.5 * (
        2 * start
        + (end - before) * t
        + (2 * before - 5 * start + 4 * end - after) * t**2
        + (-before + 3 * start - 3 * end + after) * t**3
    )
    curve[:, 0] = np.maximum(curve[:, 0], TINY)
    return curve


def ellipsoid(center: ArrayLike, radii: ArrayLike, rows: int = 20, segments: int = 32) -> Mesh:
    latitude = np.linspace(1e-3, np.pi - 1e-3, rows)
    ball = lathe(np.stack([np.sin(latitude), -np.cos(latitude)], 1), segments)
    return Mesh(ball.vertices * np.broadcast_to(radii, 3) + np.asarray(center, float), ball.faces)


def torus(major: float, minor: float, segments: int = 48, sides: int = 18, arc: float = 2 * np.pi) -> Mesh:
    """A ring in the xy plane, or an arc of it symmetric about the x axis (a handle)."""
    closed = arc >= 2 * np.pi
    u = np.linspace(-arc / 2, arc / 2, segments, endpoint=not closed)[:, None]
    v = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None]
    reach = major + minor * np.cos(v)
    vertices = np.stack([reach * np.cos(u), reach * np.sin(u), np.repeat(minor * np.sin(v), segments, 0)], -1)
    faces = grid_quads(segments, sides, wrap=True)
    if closed:
        last = (segments - 1) * sides
        faces += [(last + j, last + (j + 1) % sides, (j + 1) % sides, j) for j in range(sides)]
    return Mesh(vertices.reshape(-1, 3), faces)


def tube(path: ArrayLike, radii: ArrayLike, sides: int = 16) -> Mesh:
    """A closed tube along ``path [n, 3]`` with ``radii [n]``."""
    path = np.asarray(path, float)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.where(np.abs(tangent[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(tangent, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(tangent, across)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    radius = np.asarray(radii, float)[:, None, None]
    vertices = path[:, None] + radius * (np.cos(angle) * across[:, None] + np.sin(angle) * other[:, None])
    n = len(path)
    caps = [tuple(range(sides))[::-1], tuple((n - 1) * sides + j for j in range(sides))]
    return Mesh(vertices.reshape(-1, 3), grid_quads(n, sides, wrap=True) + caps)


def box(size: ArrayLike, center: ArrayLike = (0, 0, 0)) -> Mesh:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces: list[tuple[int, ...]] = [
        (0, 1, 3, 2),
        (4, 6, 7, 5),
        (0, 4, 5, 1),
        (2, 3, 7, 6),
        (0, 2, 6, 4),
        (1, 5, 7, 3),
    ]
    return Mesh(corners * np.asarray(size, float) + np.asarray(center, float), faces)


def draped_sheet(half_width: float, half_depth: float, phases: ArrayLike, points: int = 60) -> Mesh:
    """A cloth with low waves on z = 0."""
    a, b, c = np.asarray(phases, float)
    x, y = np.meshgrid(
        np.linspace(-half_width, half_width, points), np.linspace(-half_depth, half_depth, points)
    )
    z = 0.018 + 0.012 * np.sin(5 * x + a) * np.sin(3 * y + b) + 0.006 * np.sin(11 * x + 7 * y + c)
    return Mesh(np.stack([x, y, z], -1).reshape(-1, 3), grid_quads(points, points, wrap=False))


def leaf(base: ArrayLike, azimuth: float, elevation: float, length: float, width: float) -> Mesh:
    """A folded leaf that starts at ``base`` and bends down (angles in radians)."""
    steps = 8
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    sideways = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    u = np.linspace(0, 1, steps + 1)
    slope = elevation - 1.5 * u**2
    direction = np.cos(slope)[:, None] * outward + np.sin(slope)[:, None] * [0.0, 0.0, 1.0]
    advance = np.cumsum(direction[:-1] * length / steps, 0)
    spine = np.asarray(base, float) + np.concatenate([np.zeros((1, 3)), advance])
    half = width * np.sin(np.pi * np.minimum(0.98, 0.9 * u + 0.08))[:, None] ** 0.8
    lift = half * [0.0, 0.0, 0.25]
    rows = np.stack([spine - sideways * half + lift, spine, spine + sideways * half + lift], 1)
    return Mesh(rows.reshape(-1, 3), grid_quads(steps + 1, 3, wrap=False))
