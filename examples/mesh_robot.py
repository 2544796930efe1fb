"""A ring from a triangle mesh falls onto a floor; the forces of the floor are measured. Leaves mesh_robot.png."""

import dataclasses
import math
import sys

import matplotlib.pyplot as plt
import numpy as np
import torch
import trimesh

import softmpm

quick = "--quick" in sys.argv
cell, seconds, period = (0.014, 0.12, 0.005) if quick else (0.01, 0.4, 0.004)

# Any closed mesh will do; trimesh.load_mesh("robot.stl") reads a file.
ring = trimesh.creation.torus(major_radius=0.06, minor_radius=0.02)
ring.apply_transform(trimesh.transformations.rotation_matrix(math.radians(70), (1.0, 0.0, 0.0)))  # it stands
ring.apply_translation((0.15, 0.15, 0.05 - ring.bounds[0, 2] + 0.02))  # 20 mm above the floor
shape = softmpm.mesh(ring, spacing=cell / 2)
nodes = np.ceil(np.array([0.3, 0.3, 0.25]) / cell).astype(int)
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=tuple(nodes), spacing=cell),
    bodies=[softmpm.Body(shape, softmpm.presets.ECOFLEX_00_30.material())],
    walls=[softmpm.Wall(normal=(0.0, 0.0, 1.0), offset=0.05, friction=0.5)],
    gravity=(0.0, 0.0, -9.81),
    body_contact=False,
    dt=1e-6,
)
substeps = math.ceil(period / (0.5 * softmpm.stable_dt(scene)))
scene = dataclasses.replace(scene, dt=period / substeps)
model = softmpm.build(scene, formulation="auto")
params = model.params()


def observe(state):
    force = softmpm.contact_forces(model, state).total[0, 0]  # mean of the control step [N], shape (dim,)
    return {"force": force, "momentum": softmpm.momentum(model, state, params)[0]}


with torch.no_grad():
    steps = round(seconds / period)
    way = softmpm.trajectory(
        model, model.rest(), None, params, substeps=substeps, control_steps=steps, observe=observe
    )
force, momentum = way.frames["force"][:, 2].cpu(), way.frames["momentum"][:, 2].cpu()
weight = 9.81 * model.mass.sum().item()
impulse = (force - weight).sum() * period  # what the floor and gravity gave the ring [N s]
print(f"weight {weight:.2f} N, largest force {force.max():.1f} N")
print(f"impulse {impulse:.5f} N s, momentum at the end {momentum[-1]:.5f} kg m/s")

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
softmpm.show(model, way.end, colour="strain", axes=left)
right.plot(period * np.arange(1, steps + 1), force, label="floor on ring")
right.axhline(weight, color="gray", linestyle="--", label="weight")
right.set(xlabel="time [s]", ylabel="vertical force [N]")
right.legend()
figure.savefig("mesh_robot.png", dpi=110)
