"""Numba kernels of the CPU rasterizer. They work on NumPy arrays; `cpu_backend` connects them to autograd.

The first arguments of a kernel are ``start, stop``, the range of its work items (Gaussians or tiles). A kernel writes
only to its own items, so the result does not depend on the number of threads.
"""
