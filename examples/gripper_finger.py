"""A soft finger in 3D learns the activation of its four muscles that brings the tip to a place. Leaves gripper_finger.png."""

import dataclasses
import math
import sys

import numpy as np
import torch

import softmpm

cell, iterations = (0.015, 6) if "--quick" in sys.argv else (0.0075, 15)  # [m]; 2 or 4 cells across it
period = 0.05  # length of a control step [s]
target = (0.125, 0.085, 0.045)  # [m]; the tip at rest is at (0.15, 0.06, 0.06)

# The finger is 120 mm long and 30 mm thick, and begins in the plane of the wall that clamps it.
finger = softmpm.box((0.03, 0.045, 0.045), (0.15, 0.075, 0.075), spacing=cell / 2)
x, y, z = finger.positions.T
sides = [np.flatnonzero(side) for side in (y > 0.065, y < 0.055, z > 0.065, z < 0.055)]
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=[round(side / cell) + 1 for side in (0.18, 0.12, 0.12)], spacing=cell),
    bodies=[softmpm.Body(finger, softmpm.presets.ECOFLEX_00_30.material())],
    muscles=[softmpm.Muscle(particles=side, direction=(1.0, 0.0, 0.0), strength=6e4) for side in sides],
    walls=[softmpm.Wall(normal=(1.0, 0.0, 0.0), offset=0.03, contact="clamp")],
    damping=40.0,  # so that it comes to rest within the time simulated
    dt=1e-6,
)
substeps = math.ceil(period / (0.5 * softmpm.stable_dt(scene)))
scene = dataclasses.replace(scene, dt=period / substeps)
model = softmpm.build(scene, formulation="reference")  # which clamps need
print(model.describe())

tip = torch.from_numpy(np.flatnonzero(x > x.max() - cell)).to(model.device)
goal = torch.tensor(target, device=model.device)
control = torch.full((4,), 0.05, device=model.device, requires_grad=True)
optimizer = torch.optim.Adam([control], lr=0.1)
ramp = torch.linspace(0.2, 1.0, 5, device=model.device)[:, None, None]  # (control step, world, muscle)

distances = []
for iteration in range(iterations):
    activation = ramp * torch.tanh(control.abs())
    end = softmpm.simulate(model, model.rest(), activation, model.params(), substeps=substeps)
    distance = (end.x[0, tip].mean(0) - goal).norm()
    optimizer.zero_grad()
    (distance / 0.01).square().backward()  # smooth at the target, unlike the distance
    optimizer.step()
    distances.append(1000 * distance.item())
    print(f"iteration {iteration}: the tip is {distances[-1]:.1f} mm from its target")

softmpm.show(model, end.detach(), colour="strain").savefig("gripper_finger.png", dpi=110)
