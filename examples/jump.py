"""Co-design of a jump: Young's modulus of three regions is learned with the activation of two muscles. Leaves jump.png."""

import dataclasses
import math
import sys

import matplotlib.pyplot as plt
import numpy as np
import torch

import softmpm

iterations = 12 if "--quick" in sys.argv else 40
cell, gravity, period = 0.0125, 9.81, 0.0125  # [m], [m/s²], [s]

# A table on two legs. The muscle of the legs pulls along them, and pushes where its activation is negative.
table = [(0.15, 0.11), (0.35, 0.11), (0.35, 0.16), (0.15, 0.16)]
legs = [[(left, 0.05), (left + 0.05, 0.05), (left + 0.05, 0.13), (left, 0.13)] for left in (0.15, 0.30)]
robot = softmpm.polygons([table, *legs], spacing=cell / 2)
height = robot.positions[:, 1]
parts = [(np.flatnonzero(height > 0.11), (1.0, 0.0)), (np.flatnonzero(height < 0.11), (0.0, 1.0))]
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=(40, 40), spacing=cell),
    bodies=[softmpm.Body(robot, softmpm.NeoHookean(density=1000.0, young=5e4, poisson=0.3, viscosity=10.0))],
    muscles=[softmpm.Muscle(particles=p, direction=d, strength=1e4) for p, d in parts],
    walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.05, friction=0.8)],
    gravity=(0.0, -gravity),
    dt=1e-6,
)
substeps = math.ceil(period / (0.3 * softmpm.stable_dt(scene)))  # room for a body twice as stiff
scene = dataclasses.replace(scene, dt=period / substeps)
model = softmpm.build(scene, formulation="reference", contact_width=0.01)
region = torch.from_numpy(np.digitize(height, (0.08, 0.11))).to(model.device)  # feet, legs, table
base = model.params()

curves, (figure, (left, right)) = {}, plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for name, rate in (("activation", 0.0), ("activation and E", 0.1)):
    design = torch.zeros(3, device=model.device, requires_grad=True)
    control = torch.zeros(12, 1, 2, device=model.device, requires_grad=True)  # (control step, world, muscle)
    optimizer = torch.optim.Adam([{"params": [design], "lr": rate}, {"params": [control], "lr": 0.05}])
    curves[name] = []
    for _ in range(iterations):
        params = base._replace(young=base.young * (2.0 ** design.tanh())[region])  # within a factor of two
        activation = torch.cat([torch.tanh(control), torch.zeros_like(control)])  # and 0.15 s to take off
        end = softmpm.simulate(model, model.rest(), activation, params, substeps=substeps)
        upward = softmpm.mean_velocity(model, end, params)[0, 1]  # in flight it rises by another v²/2g:
        apex = softmpm.center_of_mass(model, end, params)[0, 1] + upward * upward.abs() / (2 * gravity)
        optimizer.zero_grad()
        (-apex).backward()
        optimizer.step()
        curves[name].append(1000 * apex.item())
    right.plot(curves[name], label=name)
    print(f"{name}: apex from {curves[name][0]:.0f} to {curves[name][-1]:.0f} mm")
young = params.young.detach() / 1000
softmpm.show(model, end.detach(), colour=young, label="E [kPa]", axes=left)
right.set(xlabel="iteration", ylabel="apex of the centre of mass [mm]")
right.legend()
figure.savefig("jump.png", dpi=110)
