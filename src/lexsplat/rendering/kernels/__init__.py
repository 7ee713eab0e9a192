"""Numba kernels of the CPU rasterizer. They see NumPy arrays only; autograd lives in `cpu_backend`.

Every kernel takes ``start, stop`` first and does that range of its work items (Gaussians or tiles). It writes
nothing outside its own items, so the result cannot depend on the number of threads.
"""
