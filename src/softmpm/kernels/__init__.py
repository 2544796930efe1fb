"""Warp functions and kernels, specialised by what a scene contains. Each adjoint twin stands below its function."""
