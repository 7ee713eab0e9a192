"""Colors from real spherical harmonics up to degree 4, forward and backward."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lexsplat.rendering.kernels.arrays import F32, F64, I32
from lexsplat.rendering.kernels.jit import kernel


@kernel
def _basis(x: float, y: float, z: float, degree: int, b: F64) -> None:
    """Evaluate the basis at a unit direction."""
    b[0] = 0.28209479177387814
    if degree < 1:
        return
    b[1] = -0.4886025119029199 * y
    b[2] = 0.4886025119029199 * z
    b[3] = -0.4886025119029199 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    b[4] = 1.0925484305920792 * x * y
    b[5] = -1.0925484305920792 * y * z
    b[6] = 0.31539156525252005 * (3.0 * zz - 1.0)
    b[7] = -1.0925484305920792 * x * z
    b[8] = 0.5462742152960396 * (xx - yy)
    if degree < 3:
        return
    b[9] = -0.5900435899266435 * y * (3.0 * xx - yy)
    b[10] = 2.890611442640554 * x * y * z
    b[11] = -0.4570457994644658 * y * (5.0 * zz - 1.0)
    b[12] = 0.3731763325901154 * z * (5.0 * zz - 3.0)
    b[13] = -0.4570457994644658 * x * (5.0 * zz - 1.0)
    b[14] = 1.445305721320277 * z * (xx - yy)
    b[15] = -0.5900435899266435 * x * (xx - 3.0 * yy)
    if degree < 4:
        return
    b[16] = 2.5033429417967046 * x * y * (xx - yy)
    b[17] = -1.7701307697799304 * y * z * (3.0 * xx - yy)
    b[18] = 0.9461746957575601 * x * y * (7.0 * zz - 1.0)
    b[19] = -0.6690465435572892 * y * z * (7.0 * zz - 3.0)
    b[20] = 0.10578554691520431 * (35.0 * zz * zz - 30.0 * zz + 3.0)
    b[21] = -0.6690465435572892 * x * z * (7.0 * zz - 3.0)
    b[22] = 0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0)
    b[23] = -1.7701307697799304 * x * z * (xx - 3.0 * yy)
    b[24] = 0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))


@kernel
def _basis_gradient(x: float, y: float, z: float, degree: int, d: F64) -> None:
    """Derivatives ``[25, 3]`` of `_basis` w.r.t. x, y and z, not projected to the tangent of the sphere."""
    d[:] = 0.0
    if degree < 1:
        return
    d[1, 1] = -0.4886025119029199
    d[2, 2] = 0.4886025119029199
    d[3, 0] = -0.4886025119029199
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    k = 1.0925484305920792
    d[4, 0], d[4, 1] = k * y, k * x
    d[5, 1], d[5, 2] = -k * z, -k * y
    d[6, 2] = 6.0 * 0.31539156525252005 * z
    d[7, 0], d[7, 2] = -k * z, -k * x
    d[8, 0], d[8, 1] = k * x, -k * y
    if degree < 3:
        return
    k = 0.5900435899266435
    d[9, 0], d[9, 1] = -6.0 * k * x * y, -3.0 * k * (xx - yy)
    d[15, 0], d[15, 1] = -3.0 * k * (xx - yy), 6.0 * k * x * y
    k = 2.890611442640554
    d[10, 0], d[10, 1], d[10, 2] = k * y * z, k * x * z, k * x * y
    k = 0.4570457994644658
    d[11, 1], d[11, 2] = -k * (5.0 * zz - 1.0), -10.0 * k * y * z
    d[12, 2] = 0.3731763325901154 * (15.0 * zz - 3.0)
    d[13, 0], d[13, 2] = -k * (5.0 * zz - 1.0), -10.0 * k * x * z
    k = 1.445305721320277
    d[14, 0], d[14, 1], d[14, 2] = 2.0 * k * x * z, -2.0 * k * y * z, k * (xx - yy)
    if degree < 4:
        return
    k = 2.5033429417967046
    d[16, 0], d[16, 1] = k * y * (3.0 * xx - yy), k * x * (xx - 3.0 * yy)
    k = 1.7701307697799304
    d[17, 0], d[17, 1], d[17, 2] = -6.0 * k * x * y * z, -3.0 * k * z * (xx - yy), -k * y * (3.0 * xx - yy)
    d[23, 0], d[23, 1], d[23, 2] = -3.0 * k * z * (xx - yy), 6.0 * k * x * y * z, -k * x * (xx - 3.0 * yy)
    k = 0.9461746957575601
    d[18, 0], d[18, 1], d[18, 2] = k * y * (7.0 * zz - 1.0), k * x * (7.0 * zz - 1.0), 14.0 * k * x * y * z
    k = 0.6690465435572892
    d[19, 1], d[19, 2] = -k * z * (7.0 * zz - 3.0), -k * y * (21.0 * zz - 3.0)
    d[20, 2] = 0.10578554691520431 * (140.0 * zz * z - 60.0 * z)
    d[21, 0], d[21, 2] = -k * z * (7.0 * zz - 3.0), -k * x * (21.0 * zz - 3.0)
    k = 0.47308734787878004
    d[22, 0], d[22, 1] = 2.0 * k * x * (7.0 * zz - 1.0), -2.0 * k * y * (7.0 * zz - 1.0)
    d[22, 2] = 14.0 * k * z * (xx - yy)
    k = 4.0 * 0.6258357354491761
    d[24, 0], d[24, 1] = k * x * (xx - 3.0 * yy), k * y * (yy - 3.0 * xx)


@kernel
def shade(
    start: int, stop: int, degree: int, means: F32, eye: F64, sh0: F32, shN: F32, radii: I32, colors: F32
) -> None:
    """RGB of each visible Gaussian seen from ``eye``: max(0, SH + 0.5)."""
    b = np.empty(25)
    count = (degree + 1) * (degree + 1)
    for n in range(start, stop):
        if radii[n] == 0:
            colors[n, 0] = colors[n, 1] = colors[n, 2] = np.float32(0)
            continue
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        _basis(x * inverse, y * inverse, z * inverse, degree, b)
        for c in range(3):
            total = 0.5 + b[0] * sh0[n, 0, c]
            for k in range(1, count):
                total += b[k] * shN[n, k - 1, c]
            colors[n, c] = max(total, 0.0)


@kernel
def shade_backward(
    start: int,
    stop: int,
    degree: int,
    means: F32,
    eye: F64,
    shN: F32,
    radii: I32,
    colors: F32,
    grad_colors: F32,
    grad_means: F32,
    grad_sh0: F32,
    grad_shN: F32,
) -> None:
    """Gradients of `shade`; the gradient of a channel clamped to zero is zero."""
    b = np.empty(25)
    d = np.empty((25, 3))
    count = (degree + 1) * (degree + 1)
    for n in range(start, stop):
        for c in range(3):
            grad_means[n, c] = grad_sh0[n, 0, c] = np.float32(0)
        for k in range(grad_shN.shape[1]):
            for c in range(3):
                grad_shN[n, k, c] = np.float32(0)
        if radii[n] == 0:
            continue
        r = np.float64(grad_colors[n, 0]) if colors[n, 0] > 0 else 0.0
        g = np.float64(grad_colors[n, 1]) if colors[n, 1] > 0 else 0.0
        u = np.float64(grad_colors[n, 2]) if colors[n, 2] > 0 else 0.0
        grad_sh0[n, 0, 0] = 0.28209479177387814 * r
        grad_sh0[n, 0, 1] = 0.28209479177387814 * g
        grad_sh0[n, 0, 2] = 0.28209479177387814 * u
        if count == 1:
            continue
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        x *= inverse
        y *= inverse
        z *= inverse
        _basis(x, y, z, degree, b)
        _basis_gradient(x, y, z, degree, d)
        gx = gy = gz = 0.0
        for k in range(1, count):
            grad_shN[n, k - 1, 0] = b[k] * r
            grad_shN[n, k - 1, 1] = b[k] * g
            grad_shN[n, k - 1, 2] = b[k] * u
            weight = r * shN[n, k - 1, 0] + g * shN[n, k - 1, 1] + u * shN[n, k - 1, 2]
            gx += weight * d[k, 0]
            gy += weight * d[k, 1]
            gz += weight * d[k, 2]
        along = gx * x + gy * y + gz * z
        grad_means[n, 0] = (gx - along * x) * inverse
        grad_means[n, 1] = (gy - along * y) * inverse
        grad_means[n, 2] = (gz - along * z) * inverse


def basis_at(directions: NDArray[np.float64], degree: int) -> F64:
    """Values of the basis ``[M, (degree + 1)^2]`` at unit directions ``[M, 3]``."""
    values = np.zeros((len(directions), 25))
    for row, (x, y, z) in zip(values, np.asarray(directions, dtype=np.float64)):
        _basis(x, y, z, degree, row)
    return values[:, : (degree + 1) ** 2]
