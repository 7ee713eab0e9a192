"""Projection of 3D Gaussians to ellipses on the image (EWA splatting), forward and backward.

Arithmetic is in float64, which preserves the determinant of thin Gaussians at no measurable cost.
"""

from __future__ import annotations

import math

import numpy as np

from lexsplat.rendering.kernels.arrays import F32, F64, I32
from lexsplat.rendering.kernels.jit import kernel

Triple = tuple[float, float, float]

DILATION = 0.3
"""Added to both variances of every ellipse, in square pixels (gsplat's ``eps2d``)."""
ALPHA_THRESHOLD = 1.0 / 255.0
"""Contributions below this are skipped."""
CLAMP_MARGIN = 0.3
"""The Jacobian is evaluated inside the field of view, widened on each side by this fraction of half its tangent."""

# Fields of the camera vector after the rotation (0 to 8, row by row) and the translation (9 to 11).
FX, FY, CX, CY, WIDTH, HEIGHT, NEAR = 12, 13, 14, 15, 16, 17, 18


@kernel
def _rotation(quat: F32, index: int, matrix: F64) -> float:
    """Write the rotation matrix of a quaternion to ``matrix``; returns the length of the quaternion."""
    w, x = np.float64(quat[index, 0]), np.float64(quat[index, 1])
    y, z = np.float64(quat[index, 2]), np.float64(quat[index, 3])
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
def _to_camera(camera: F64, means: F32, n: int) -> Triple:
    """Center of a Gaussian in camera space."""
    x, y, z = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
    tx = camera[0] * x + camera[1] * y + camera[2] * z + camera[9]
    ty = camera[3] * x + camera[4] * y + camera[5] * z + camera[10]
    tz = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
    return tx, ty, tz


@kernel
def _find_axes(camera: F64, log_scales: F32, n: int, rotation: F64, scale: F64, axes: F64) -> None:
    """Principal axes of the Gaussian in camera space, the columns of R_camera R_gaussian S; writes S to ``scale``."""
    for j in range(3):
        scale[j] = math.exp(np.float64(log_scales[n, j]))
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += camera[3 * i + k] * rotation[3 * k + j]
            axes[3 * i + j] = total * scale[j]


@kernel
def _clamped_slope(slope: float, focal: float, center: float, size: float) -> float:
    margin = CLAMP_MARGIN * 0.5 * size / focal
    return min(max(slope, -(center / focal + margin)), (size - center) / focal + margin)


@kernel
def _image_axis(row: int, focal: float, slope: float, axes: F64) -> Triple:
    """A row of the Jacobian (0 horizontal, 1 vertical) times the principal axes; ``focal`` is divided by depth."""
    return (
        focal * (axes[3 * row] - slope * axes[6]),
        focal * (axes[3 * row + 1] - slope * axes[7]),
        focal * (axes[3 * row + 2] - slope * axes[8]),
    )


@kernel
def _covariance(u: Triple, v: Triple) -> tuple[float, float, float, float, float]:
    """Covariance [[a, b], [b, c]] of the ellipse with image axes u and v.

    Returns:
        a, b, c and the determinant before dilation, and the determinant after it.
    """
    a = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    b = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    c = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    # |u x v|^2 equals the determinant ac - b^2 without its cancellation.
    n0, n1, n2 = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    sharp = n0 * n0 + n1 * n1 + n2 * n2
    return a, b, c, sharp, sharp + DILATION * (a + c) + DILATION * DILATION


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
    """Ellipse, effective opacity, depth and radius of each Gaussian; radius 0 if it is invisible."""
    rotation, axes, scale = np.empty(9), np.empty(9), np.empty(3)
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    width, height, near = camera[WIDTH], camera[HEIGHT], camera[NEAR]
    for n in range(start, stop):
        radii[n] = 0
        means2d[n, 0] = means2d[n, 1] = np.float32(0)
        conics[n, 0] = conics[n, 1] = conics[n, 2] = np.float32(0)
        opacities[n] = depths[n] = extents[n, 0] = extents[n, 1] = np.float32(0)
        tx, ty, tz = _to_camera(camera, means, n)
        if not (tz >= near and tz <= 1e10):
            continue
        opacity = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[n])))
        if not opacity >= ALPHA_THRESHOLD:
            continue
        if _rotation(quats, n, rotation) == 0.0:
            continue
        _find_axes(camera, log_scales, n, rotation, scale, axes)
        u = _image_axis(0, fx / tz, _clamped_slope(tx / tz, fx, cx, width), axes)
        v = _image_axis(1, fy / tz, _clamped_slope(ty / tz, fy, cy, height), axes)
        a, b, c, sharp, det = _covariance(u, v)
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
def _through_inverse(grad_conics: F32, n: int, a: float, b: float, c: float, det: float) -> Triple:
    """Gradient w.r.t. the covariance from the gradient w.r.t. its inverse: d conic = -conic d cov conic."""
    p, q, r = (c + DILATION) / det, -b / det, (a + DILATION) / det
    gp, gr = np.float64(grad_conics[n, 0]), np.float64(grad_conics[n, 2])
    gq = 0.5 * np.float64(grad_conics[n, 1])
    m00, m01 = gp * p + gq * q, gp * q + gq * r
    m10, m11 = gq * p + gr * q, gq * q + gr * r
    return -(p * m00 + q * m10), -2.0 * (p * m01 + q * m11), -(q * m01 + r * m11)


@kernel
def _through_mip_filter(
    grad: float, a: float, b: float, c: float, sharp: float, det: float
) -> tuple[float, float, float, float]:
    """Gradients w.r.t. a, b and c through the factor sqrt(sharp / det) of the opacity, and the factor."""
    compensation = math.sqrt(sharp / det)
    factor = grad / (2.0 * compensation * det)
    share = compensation * compensation
    return (
        factor * (c - share * (c + DILATION)),
        factor * (-2.0 * b * (1.0 - share)),
        factor * (a - share * (a + DILATION)),
        compensation,
    )


@kernel
def _along_axis(grad_square: float, grad_product: float, axis: Triple, other: Triple) -> Triple:
    """Gradient w.r.t. an image axis from those w.r.t. its square and its product with the other axis."""
    return (
        2.0 * grad_square * axis[0] + grad_product * other[0],
        2.0 * grad_square * axis[1] + grad_product * other[1],
        2.0 * grad_square * axis[2] + grad_product * other[2],
    )


@kernel
def _through_image_axis(row: int, focal: float, axes: F64, grad: Triple, grad_axes: F64) -> float:
    """Write row ``row`` of ``grad_axes`` from the gradient w.r.t. `_image_axis`; returns that w.r.t. the slope."""
    grad_axes[3 * row] = focal * grad[0]
    grad_axes[3 * row + 1] = focal * grad[1]
    grad_axes[3 * row + 2] = focal * grad[2]
    return -focal * (axes[6] * grad[0] + axes[7] * grad[1] + axes[8] * grad[2])


@kernel
def _through_axes(
    camera: F64, scale: F64, axes: F64, grad_axes: F64, n: int, grad_log_scales: F32, grad_rotation: F64
) -> None:
    """Gradients w.r.t. the log scales and the rotation of the Gaussian from the gradient w.r.t. its axes."""
    for j in range(3):
        total = axes[j] * grad_axes[j] + axes[3 + j] * grad_axes[3 + j] + axes[6 + j] * grad_axes[6 + j]
        grad_log_scales[n, j] = total
        for k in range(3):
            total = (
                camera[k] * grad_axes[j] + camera[3 + k] * grad_axes[3 + j] + camera[6 + k] * grad_axes[6 + j]
            )
            grad_rotation[3 * k + j] = total * scale[j]


@kernel
def _quaternion_gradient(quats: F32, n: int, length: float, g: F64, grad_quats: F32) -> None:
    """Gradient w.r.t. the unnormalized quaternion from the gradient ``g`` w.r.t. its rotation matrix."""
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
    """Gradients of `project`; those of invisible Gaussians are zero.

    ``grad_shaded [N, 3]`` is the gradient w.r.t. the means through the colors; it is added to ``grad_means``.
    """
    rotation, axes, scale = np.empty(9), np.empty(9), np.empty(3)
    grad_axes, grad_rotation = np.empty(9), np.empty(9)
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    for n in range(start, stop):
        if radii[n] == 0:
            grad_means[n, :] = grad_log_scales[n, :] = np.float32(0)
            grad_quats[n, :] = np.float32(0)
            grad_opacity_logits[n] = np.float32(0)
            continue
        # Recomputing the forward pass is cheaper than storing its intermediate values.
        tx, ty, tz = _to_camera(camera, means, n)
        length = _rotation(quats, n, rotation)
        _find_axes(camera, log_scales, n, rotation, scale, axes)
        slope_x = _clamped_slope(tx / tz, fx, cx, camera[WIDTH])
        slope_y = _clamped_slope(ty / tz, fy, cy, camera[HEIGHT])
        px, py = fx / tz, fy / tz
        u, v = _image_axis(0, px, slope_x, axes), _image_axis(1, py, slope_y, axes)
        a, b, c, sharp, det = _covariance(u, v)

        grad_a, grad_b, grad_c = _through_inverse(grad_conics, n, a, b, c, det)
        sigmoid = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[n])))
        grad_opacity = np.float64(grad_opacities[n])
        if antialiased:
            more_a, more_b, more_c, factor = _through_mip_filter(grad_opacity * sigmoid, a, b, c, sharp, det)
            grad_a += more_a
            grad_b += more_b
            grad_c += more_c
            grad_opacity *= factor
        grad_opacity_logits[n] = grad_opacity * sigmoid * (1.0 - sigmoid)

        # Through rows u and v of Jacobian times axes to the Jacobian and the axes.
        gu, gv = _along_axis(grad_a, grad_b, u, v), _along_axis(grad_c, grad_b, v, u)
        grad_slope_x = _through_image_axis(0, px, axes, gu, grad_axes)
        grad_slope_y = _through_image_axis(1, py, axes, gv, grad_axes)
        for j in range(3):
            grad_axes[6 + j] = -slope_x * grad_axes[j] - slope_y * grad_axes[3 + j]
        gtz = -(gu[0] * u[0] + gu[1] * u[1] + gu[2] * u[2] + gv[0] * v[0] + gv[1] * v[1] + gv[2] * v[2]) / tz

        # A clamped slope is constant; an unclamped slope and the center depend on t / tz.
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

        _through_axes(camera, scale, axes, grad_axes, n, grad_log_scales, grad_rotation)
        _quaternion_gradient(quats, n, length, grad_rotation, grad_quats)
