"""A robot from a picture, crawler.png: dark pixels are its body, red and blue ones its muscles. Leaves image_robot.png."""

import dataclasses
import math
import sys

import numpy as np
import torch
from PIL import Image, ImageDraw

import softmpm

iterations = 3 if "--quick" in sys.argv else 40
cell, control_steps, period = 0.0125, 24, 0.025  # [m], -, [s]

# Any drawing program will do. One pixel is 1 mm.
drawing = Image.new("RGB", (220, 120), "white")
pen = ImageDraw.Draw(drawing)
pen.rounded_rectangle((10, 10, 210, 60), radius=20, fill="dimgray")
pen.rectangle((30, 45, 65, 119), fill="red")
pen.rectangle((155, 45, 190, 119), fill="blue")
drawing.save("crawler.png")

corner, height = (0.1, 0.05), 0.12  # of the picture [m]
shape = softmpm.image("crawler.png", corner, height=height, spacing=cell / 2, threshold=0.9, cut_cells=True)
pixel = ((shape.positions - corner) / (height / drawing.height)).astype(int)
red, _, blue = np.asarray(drawing)[drawing.height - 1 - pixel[:, 1], pixel[:, 0]].T.astype(int)
muscles = [
    softmpm.Muscle(particles=np.flatnonzero(mask), direction=(0.0, 1.0), strength=1e4, name=name)
    for name, mask in (("red", red > blue + 100), ("blue", blue > red + 100))
]
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=(64, 24), spacing=cell),
    bodies=[softmpm.Body(shape, softmpm.NeoHookean(density=1000.0, young=5e4, poisson=0.3, viscosity=20.0))],
    muscles=muscles,
    walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.05, friction=0.8)],
    gravity=(0.0, -9.81),
    body_contact=False,
    dt=1e-6,
)
substeps = math.ceil(period / (0.4 * softmpm.stable_dt(scene)))
scene = dataclasses.replace(scene, dt=period / substeps)
model = softmpm.build(scene, formulation="auto", contact_width=0.01)

# A small wave in both legs, one ahead of the other, is a start that gradients can improve.
phase = 2 * torch.pi * torch.arange(control_steps, device=model.device) / 12
control = 0.3 * torch.stack([phase.sin(), phase.cos()], dim=-1)[:, None]  # (control step, world, muscle)
control.requires_grad_()
optimizer, distances = torch.optim.Adam([control], lr=0.07), []

for iteration in range(iterations):
    end = softmpm.simulate(model, model.rest(), torch.tanh(control), model.params(), substeps=substeps)
    distance = (end.x - model.positions)[..., 0].mean()
    optimizer.zero_grad()
    (-distance).backward()
    optimizer.step()
    distances.append(1000 * distance.item())
    print(f"{iteration}: {distances[-1]:.1f} mm to the right")
softmpm.show(model, end.detach(), colour="muscle").savefig("image_robot.png", dpi=110)
