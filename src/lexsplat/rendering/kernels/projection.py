"""Projection of 3D Gaussians to ellipses on the image (EWA splatting), forward and backward.

Arithmetic is float64 inside: it costs nothing here and thin Gaussians keep their determinant.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lexsplat.rendering.kernels.jit import kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

DILATION = 0.3
"""Added to both variances of every ellipse, square pixels (gsplat's ``eps2d``)."""
ALPHA_THRESHOLD = 1.0 / 255.0
"""Contributions below this are skipped."""
CLAMP_MARGIN = 0.3
"""The Jacobian is taken inside the field of view widened by this share of half its tangent."""

# Fields of the camera vector.
ROTATION, TRANSLATION, FX, FY, CX, CY, WIDTH, HEIGHT, NEAR, CAMERA_FIELDS = (
    0,
    9,
    12,
    13,
    14,
    15,
    16,
    17,
    18,
    19,
)


@kernel
def _rotation(quat: F32, index: int, matrix: F64) -> float:
    """Rotation matrix of a quaternion; returns its length."""
    w, x, y, z = (
        np.float64(quat[index, 0]),
        np.float64(quat[index, 1]),
        np.float64(quat[index, 2]),
        np.float64(quat[index, 3]),
    )
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not length > 0.0:
        return 0.0
    w /= length
    x /= length
    y /= length
    z /= length
    matrix[0] = 1.0 - 2.0 * (y * y + z * z)
    matrix[1] = 2.0 * (x * y - w * z)
    matrix[2] = 2.0 * (x * z + w * y)
    matrix[3] = 2.0 * (x * y + w * z)
    matrix[4] = 1.0 - 2.0 * (x * x + z * z)
    matrix[5] = 2.0 * (y * z - w * x)
    matrix[6] = 2.0 * (x * z - w * y)
    matrix[7] = 2.0 * (y * z + w * x)
    matrix[8] = 1.0 - 2.0 * (x * x + y * y)
    return length


@kernel
def _to_camera(camera: F64, rotation: F64, scale: F64, axes: F64) -> None:
    """Principal axes of the Gaussian in camera space: columns of R_camera R_gaussian S."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += camera[3 * i + k] * rotation[3 * k + j]
            axes[3 * i + j] = total * scale[j]


@kernel
def _clamped_slope(slope: float, focal: float, centre: float, size: float) -> float:
    margin = CLAMP_MARGIN * 0.5 * size / focal
    return min(max(slope, -(centre / focal + margin)), (size - centre) / focal + margin)


@kernel
def project(
    start: int,
    stop: int,
    means: F32,
    quats: F32,
    log_scales: F32,
    opacity_logits: F32,
    camera: F64,
    antialiased: bool,
    means2d: F32,
    conics: F32,
    opacities: F32,
    depths: F32,
    radii: I32,
    extents: F32,
) -> None:
    """Ellipse, effective opacity, depth and radius of each Gaussian; radius 0 where it cannot be seen."""
    rotation, axes, scale = np.empty(9), np.empty(9), np.empty(3)
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    width, height, near = camera[WIDTH], camera[HEIGHT], camera[NEAR]
    for n in range(start, stop):
        radii[n] = 0
        means2d[n, 0] = means2d[n, 1] = np.float32(0)
        conics[n, 0] = conics[n, 1] = conics[n, 2] = np.float32(0)
        opacities[n] = depths[n] = extents[n, 0] = extents[n, 1] = np.float32(0)
        x, y, z = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
        tx = camera[0] * x + camera[1] * y + camera[2] * z + camera[9]
        ty = camera[3] * x + camera[4] * y + camera[5] * z + camera[10]
        tz = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
        if not (tz >= near and tz <= 1e10):
            continue
        opacity = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[n])))
        if not opacity >= ALPHA_THRESHOLD:
            continue
        if _rotation(quats, n, rotation) == 0.0:
            continue
        for j in range(3):
            scale[j] = math.exp(np.float64(log_scales[n, j]))
        _to_camera(camera, rotation, scale, axes)
        slope_x = _clamped_slope(tx / tz, fx, cx, width)
        slope_y = _clamped_slope(ty / tz, fy, cy, height)
        u0 = fx / tz * (axes[0] - slope_x * axes[6])
        u1 = fx / tz * (axes[1] - slope_x * axes[7])
        u2 = fx / tz * (axes[2] - slope_x * axes[8])
        v0 = fy / tz * (axes[3] - slope_y * axes[6])
        v1 = fy / tz * (axes[4] - slope_y * axes[7])
        v2 = fy / tz * (axes[5] - slope_y * axes[8])
        a = u0 * u0 + u1 * u1 + u2 * u2
        b = u0 * v0 + u1 * v1 + u2 * v2
        c = v0 * v0 + v1 * v1 + v2 * v2
        # |u x v|^2 is the determinant without the cancellation of ac - b^2.
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        sharp = n0 * n0 + n1 * n1 + n2 * n2
        det = sharp + DILATION * (a + c) + DILATION * DILATION
        if antialiased:
            opacity *= math.sqrt(sharp / det)
        if not (opacity >= ALPHA_THRESHOLD and det < 1e30):
            continue
        a += DILATION
        c += DILATION
        mx = fx * tx / tz + cx
        my = fy * ty / tz + cy
        extent = math.sqrt(2.0 * math.log(opacity / ALPHA_THRESHOLD))
        extents[n, 0] = extent * math.sqrt(a)
        extents[n, 1] = extent * math.sqrt(c)
        rx, ry = math.ceil(extent * math.sqrt(a)), math.ceil(extent * math.sqrt(c))
        if not (mx + rx > 0.0 and mx - rx < width and my + ry > 0.0 and my - ry < height):
            continue
        means2d[n, 0] = mx
        means2d[n, 1] = my
        conics[n, 0] = c / det
        conics[n, 1] = -b / det
        conics[n, 2] = a / det
        opacities[n] = opacity
        depths[n] = tz
        radii[n] = np.int32(min(max(rx, ry, 1.0), 1e9))


@kernel
def project_backward(
    start: int,
    stop: int,
    means: F32,
    quats: F32,
    log_scales: F32,
    opacity_logits: F32,
    camera: F64,
    antialiased: bool,
    radii: I32,
    grad_means2d: F32,
    grad_conics: F32,
    grad_opacities: F32,
    grad_shaded: F32,
    grad_means: F32,
    grad_quats: F32,
    grad_log_scales: F32,
    grad_opacity_logits: F32,
) -> None:
    """Gradients of `project`. Gaussians that were not seen get zeros.

    ``grad_shaded [N, 3]`` is what their colours say about the means, and is added.
    """
    rotation, axes, scale = np.empty(9), np.empty(9), np.empty(3)
    grad_axes, grad_rotation = np.empty(9), np.empty(9)
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    for n in range(start, stop):
        for j in range(3):
            grad_means[n, j] = grad_log_scales[n, j] = np.float32(0)
        for j in range(4):
            grad_quats[n, j] = np.float32(0)
        grad_opacity_logits[n] = np.float32(0)
        if radii[n] == 0:
            continue
        # The forward pass again: cheaper than keeping its intermediate values.
        x, y, z = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
        tx = camera[0] * x + camera[1] * y + camera[2] * z + camera[9]
        ty = camera[3] * x + camera[4] * y + camera[5] * z + camera[10]
        tz = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
        length = _rotation(quats, n, rotation)
        for j in range(3):
            scale[j] = math.exp(np.float64(log_scales[n, j]))
        _to_camera(camera, rotation, scale, axes)
        slope_x = _clamped_slope(tx / tz, fx, cx, camera[WIDTH])
        slope_y = _clamped_slope(ty / tz, fy, cy, camera[HEIGHT])
        px, py = fx / tz, fy / tz
        u0, u1, u2 = (
            px * (axes[0] - slope_x * axes[6]),
            px * (axes[1] - slope_x * axes[7]),
            px * (axes[2] - slope_x * axes[8]),
        )
        v0, v1, v2 = (
            py * (axes[3] - slope_y * axes[6]),
            py * (axes[4] - slope_y * axes[7]),
            py * (axes[5] - slope_y * axes[8]),
        )
        a = u0 * u0 + u1 * u1 + u2 * u2
        b = u0 * v0 + u1 * v1 + u2 * v2
        c = v0 * v0 + v1 * v1 + v2 * v2
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        sharp = n0 * n0 + n1 * n1 + n2 * n2
        det = sharp + DILATION * (a + c) + DILATION * DILATION

        # Through the inverse: d conic = -conic d cov conic.
        p, q, r = (c + DILATION) / det, -b / det, (a + DILATION) / det
        gp, gq, gr = (
            np.float64(grad_conics[n, 0]),
            0.5 * np.float64(grad_conics[n, 1]),
            np.float64(grad_conics[n, 2]),
        )
        m00, m01 = gp * p + gq * q, gp * q + gq * r
        m10, m11 = gq * p + gr * q, gq * q + gr * r
        grad_a = -(p * m00 + q * m10)
        grad_b = -2.0 * (p * m01 + q * m11)
        grad_c = -(q * m01 + r * m11)

        sigmoid = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[n])))
        grad_opacity = np.float64(grad_opacities[n])
        if antialiased:
            # compensation = sqrt(sharp / det)
            compensation = math.sqrt(sharp / det)
            factor = grad_opacity * sigmoid / (2.0 * compensation * det)
            share = compensation * compensation
            grad_a += factor * (c - share * (c + DILATION))
            grad_b += factor * (-2.0 * b * (1.0 - share))
            grad_c += factor * (a - share * (a + DILATION))
            grad_opacity *= compensation
        grad_opacity_logits[n] = grad_opacity * sigmoid * (1.0 - sigmoid)

        # Rows u, v of Jacobian times axes, then the Jacobian and the axes.
        gu0, gu1, gu2 = (
            2.0 * grad_a * u0 + grad_b * v0,
            2.0 * grad_a * u1 + grad_b * v1,
            2.0 * grad_a * u2 + grad_b * v2,
        )
        gv0, gv1, gv2 = (
            2.0 * grad_c * v0 + grad_b * u0,
            2.0 * grad_c * v1 + grad_b * u1,
            2.0 * grad_c * v2 + grad_b * u2,
        )
        grad_axes[0], grad_axes[1], grad_axes[2] = px * gu0, px * gu1, px * gu2
        grad_axes[3], grad_axes[4], grad_axes[5] = py * gv0, py * gv1, py * gv2
        grad_axes[6] = -slope_x * grad_axes[0] - slope_y * grad_axes[3]
        grad_axes[7] = -slope_x * grad_axes[1] - slope_y * grad_axes[4]
        grad_axes[8] = -slope_x * grad_axes[2] - slope_y * grad_axes[5]
        grad_slope_x = -px * (axes[6] * gu0 + axes[7] * gu1 + axes[8] * gu2)
        grad_slope_y = -py * (axes[6] * gv0 + axes[7] * gv1 + axes[8] * gv2)
        gtz = -(gu0 * u0 + gu1 * u1 + gu2 * u2 + gv0 * v0 + gv1 * v1 + gv2 * v2) / tz

        # The clamped slope is a constant; the unclamped one and the centre are t / tz.
        if slope_x != tx / tz:
            grad_slope_x = 0.0
        if slope_y != ty / tz:
            grad_slope_y = 0.0
        grad_slope_x += fx * np.float64(grad_means2d[n, 0])
        grad_slope_y += fy * np.float64(grad_means2d[n, 1])
        gtx, gty = grad_slope_x / tz, grad_slope_y / tz
        gtz -= (grad_slope_x * tx + grad_slope_y * ty) / (tz * tz)
        for j in range(3):
            grad_means[n, j] = camera[j] * gtx + camera[3 + j] * gty + camera[6 + j] * gtz + grad_shaded[n, j]

        for j in range(3):
            total = axes[j] * grad_axes[j] + axes[3 + j] * grad_axes[3 + j] + axes[6 + j] * grad_axes[6 + j]
            grad_log_scales[n, j] = total
            for k in range(3):
                total = (
                    camera[k] * grad_axes[j]
                    + camera[3 + k] * grad_axes[3 + j]
                    + camera[6 + k] * grad_axes[6 + j]
                )
                grad_rotation[3 * k + j] = total * scale[j]
        _quaternion_gradient(quats, n, length, grad_rotation, grad_quats)


@kernel
def _quaternion_gradient(quats: F32, n: int, length: float, g: F64, grad_quats: F32) -> None:
    """Through the rotation matrix and the normalisation of the quaternion."""
    w, x, y, z = quats[n, 0] / length, quats[n, 1] / length, quats[n, 2] / length, quats[n, 3] / length
    gw = 2.0 * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
    gx = 2.0 * (-2.0 * x * (g[4] + g[8]) + y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]))
    gy = 2.0 * (x * (g[1] + g[3]) - 2.0 * y * (g[0] + g[8]) + z * (g[5] + g[7]) + w * (g[2] - g[6]))
    gz = 2.0 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2.0 * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    along = gw * w + gx * x + gy * y + gz * z
    grad_quats[n, 0] = (gw - along * w) / length
    grad_quats[n, 1] = (gx - along * x) / length
    grad_quats[n, 2] = (gy - along * y) / length
    grad_quats[n, 3] = (gz - along * z) / length
