"""Warp functions and kernels, specialised by what a scene contains.

Each adjoint stands below its function, or in <name>_adj.py beside it.
"""
