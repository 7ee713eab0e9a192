"""One Adam step in one pass over memory (Numba, CPU)."""

from __future__ import annotations

import numpy as np

from lexsplat.rendering.kernels.jit import kernel, parallel

NUMBERS_PER_PIECE = 65_536
"""Numbers per work item of a thread: some tens of microseconds."""


# A numeric kernel: arrays and factors one by one, as Numba takes them.
def adam_step(
    values: np.ndarray,
    gradient: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    *,
    rate: float,
    epsilon: float,
    beta1: float,
    beta2: float,
) -> None:
    """Update moments and values ``[n]`` float32 in place.

    Args:
        values: The parameter.
        gradient: Gradient of the loss.
        first: Running mean of the gradient.
        second: Running mean of the squared gradient.
        rate: Learning rate, including both bias corrections.
        epsilon: Added to the root of the second moment.
        beta1: Decay of the first moment.
        beta2: Decay of the second moment.
    """
    numbers = (np.float32(number) for number in (rate, epsilon, beta1, 1.0 - beta1, beta2, 1.0 - beta2))
    parallel(_adam, len(values), NUMBERS_PER_PIECE, values, gradient, first, second, *numbers)


@kernel
def _adam(
    start: int,
    stop: int,
    values: np.ndarray,
    gradient: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    rate: np.float32,
    epsilon: np.float32,
    keep1: np.float32,
    take1: np.float32,
    keep2: np.float32,
    take2: np.float32,
) -> None:
    for i in range(start, stop):
        g = gradient[i]
        m = keep1 * first[i] + take1 * g
        v = keep2 * second[i] + take2 * g * g
        first[i] = m
        second[i] = v
        values[i] -= rate * m / (np.sqrt(v) + epsilon)
