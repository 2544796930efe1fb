"""Young's modulus and viscosity of a bouncing ball from its trajectory. Leaves bouncing_ball.png.

The data come from a grid twice as fine: with one for both the result would be too good (an "inverse crime"). E is found to within 10 %,
which is what the coarse grid of the identification, with four cells in a radius, allows.
"""

import dataclasses
import math
import sys

import matplotlib.pyplot as plt
import torch

import softmpm

period, frames = 0.005, 60  # time between two observations [s], and their number
iterations = 7 if "--quick" in sys.argv else 9


def heights(cell, young, viscosity):
    """Height of the centre [m] of a ball that falls 0.05 m, shape (frame,), simulated on a grid of this spacing [m]."""
    shape = softmpm.ball((0.15, 0.15), 0.05, spacing=cell / 2, cut_cells=True)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=[round(0.3 / cell)] * 2, spacing=cell),
        bodies=[softmpm.Body(shape, softmpm.NeoHookean(density=1e3, young=6e4, poisson=0.4, viscosity=60.0))],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.05)],
        gravity=(0.0, -9.81),
        dt=1e-6,
    )  # its material decides the step only: it is the stiffest that the search may try
    scene = dataclasses.replace(scene, dt=period / math.ceil(period / (0.5 * softmpm.stable_dt(scene))))
    model = softmpm.build(scene, "cpu", formulation="reference", inputs=("viscosity",), calls=frames)
    params = model.params()._replace(young=young.expand(model.particle_count))
    inputs = softmpm.Inputs(viscosity=viscosity.expand(1, model.particle_count))
    given = dict(substeps=round(period / scene.dt), control_steps=frames, inputs=inputs)
    way = softmpm.trajectory(model, model.rest(), None, params, **given)
    return way.frames.x[:, 0, :, 1] @ model.mass / model.mass.sum()


data = heights(0.00625, *torch.tensor([3e4, 20.0]).split(1))
logarithm = torch.tensor([1.2e4, 5.0]).log().requires_grad_()  # of positive numbers, known to a factor
optimizer = torch.optim.LBFGS([logarithm], max_iter=iterations, line_search_fn="strong_wolfe")


def evaluate():
    optimizer.zero_grad()
    loss = (1000 * (heights(0.0125, *logarithm.exp().split(1)) - data)).square().mean()  # [mm²]
    loss.backward()
    print("E = {:.0f} Pa, viscosity = {:.1f} Pa s: loss {:.3f} mm²".format(*logarithm.exp().tolist(), loss))
    return loss


optimizer.step(evaluate)
(young, viscosity), found = logarithm.exp().tolist(), heights(0.0125, *logarithm.exp().detach().split(1))
figure, axes = plt.subplots(layout="constrained")
axes.plot(1000 * data, "k.", label="data, E = 30.0 kPa, 20 Pa s")
axes.plot(1000 * found, label=f"found, E = {young / 1000:.1f} kPa, {viscosity:.0f} Pa s")
axes.set(xlabel="frame, 5 ms apart", ylabel="height of the centre [mm]")
axes.legend()
figure.savefig("bouncing_ball.png", dpi=110)
