"""Kernels of the fast scheme: sorted particles, sums over warps."""
