"""Kernels of the reference formulation: cells of particles at rest, and nodes that carry displacement and velocity."""
