"""Kernels of the plain scheme."""
