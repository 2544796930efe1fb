"""Kernels of the surface points that the moving grid carries, for every scheme on it."""
