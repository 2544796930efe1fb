"""A fibre-reinforced material made from outside the package, in 13 worlds with a load each. Leaves material_law.png.

A law in the kernels is a file in the source tree (docs/extending.md). But a known solid with fibres, such as a tendon or silicone with
threads in it, needs none: their stress has the form of a muscle's, p (Fd)(Fd)ᵀ, where p follows the stretch instead of an activation.
The energy k1/(2 k2) (exp(k2 e²) − 1), e = |Fd|² − 1, of Holzapfel, Gasser and Ogden (2000) gives p = 2 k1 e exp(k2 e²). Each call takes
p from the state at its start, so each is one substep.
"""

import dataclasses
import sys

import matplotlib.pyplot as plt
import numpy as np
import torch

import softmpm

k1, k2, cell = 2e3, 6.0, 0.01  # [Pa], -, [m]
loads = torch.linspace(0, 6e3, 3 if "--quick" in sys.argv else 13)  # force per area at rest [Pa]

# A strip along the fibres. It may slide along both planes of symmetry, so that its strain is uniform.
strip = softmpm.box((0.05, 0.05), (0.13, 0.08), spacing=cell / 2)
x = strip.positions[:, 0]
column = ((x - 0.05) / cell).astype(int)
columns = [np.flatnonzero(column == k) for k in range(8)]
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=(26, 14), spacing=cell),
    bodies=[softmpm.Body(strip, softmpm.NeoHookean(density=1000.0, young=2e4, poisson=0.3))],
    muscles=[softmpm.Muscle(particles=p, direction=(1.0, 0.0), strength=1.0) for p in columns],  # the fibres
    walls=[softmpm.Wall(normal=n, offset=0.05, contact="symmetry") for n in ((1.0, 0.0), (0.0, 1.0))],
    damping=100.0,
    dt=1e-6,
)
scene = dataclasses.replace(scene, dt=0.12 * softmpm.stable_dt(scene))
model = softmpm.build(scene, worlds=len(loads), formulation="reference", inputs=("force",))
last = torch.from_numpy(x > x.max() - cell / 4).to(model.device)  # the particles that are pulled
force = torch.zeros(1, len(loads), model.particle_count, 2, device=model.device)
force[..., 0] = loads.to(model.device)[:, None] * 0.03 * last / last.sum()
groups = torch.from_numpy(np.eye(8)[column] / np.bincount(column)).to(force)  # (particle, muscle)
stretch, steps = {}, round(0.2 / scene.dt)
for name, stiffness in (("without fibres", 0.0), ("with fibres", k1)):
    state = model.rest()
    for k in range(steps):
        e = (state.F[..., 0].square().sum(-1) - 1) @ groups  # |Fd|² − 1 in each group, shape (world, muscle)
        p = (2 * stiffness * e * torch.exp(k2 * e**2))[None]
        inputs = softmpm.Inputs(force=force * min(1.0, 2 * k / steps))  # raised slowly, then held
        with torch.no_grad():
            state = softmpm.simulate(model, state, p, model.params(), substeps=1, inputs=inputs)
    stretch[name] = state.F[:, (x > 0.06) & (x < 0.09), 0, 0].mean(1).cpu()
    print(name, stretch[name].tolist())

figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
for name, values in stretch.items():
    axes.plot(values, loads / 1000, "o-", label=name)
axes.set(xlabel="stretch [-]", ylabel="load [kPa]")
axes.legend()
figure.savefig("material_law.png", dpi=110)
