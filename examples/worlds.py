"""One feedback policy learns in 32 worlds, each with a random goal, and is then tried on a row of goals. Leaves worlds.png."""

import dataclasses
import math
import sys

import torch

import softmpm

torch.manual_seed(0)
worlds, iterations, control_steps = (8, 20, 6) if "--quick" in sys.argv else (32, 40, 12)
finger = softmpm.box((0.05, 0.135), (0.20, 0.165), spacing=0.005)
x, y = finger.positions.T
sides = (y > 0.155).nonzero()[0], (y < 0.145).nonzero()[0]
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=(26, 31), spacing=0.01),
    bodies=[softmpm.Body(finger, softmpm.NeoHookean(density=1000.0, young=5e4, poisson=0.3, viscosity=20.0))],
    muscles=[softmpm.Muscle(particles=side, direction=(1.0, 0.0), strength=1e4) for side in sides],
    walls=[softmpm.Wall(normal=(1.0, 0.0), offset=0.05, contact="clamp")],
    damping=10.0,
    dt=1e-6,
)
substeps = math.ceil(0.02 / (0.5 * softmpm.stable_dt(scene)))  # in a control step of 20 ms
scene = dataclasses.replace(scene, dt=0.02 / substeps)
model = softmpm.build(scene, worlds=worlds, formulation="reference", calls=control_steps)
tip = torch.from_numpy((x > 0.19).nonzero()[0]).to(model.device)
layers = torch.nn.Linear(5, 32), torch.nn.Tanh(), torch.nn.Linear(32, 2), torch.nn.Tanh()
policy = torch.nn.Sequential(*layers).to(model.device)


def episode(goal):
    """Squared error of the tip's height [m²] after each control step, shape (control_step, world), and the end."""
    state, missed = model.rest(), []
    for _ in range(control_steps):
        moved, velocity = softmpm.displacement(model, state)[:, tip].mean(1), state.v[:, tip].mean(1)
        seen = torch.cat([moved / 0.05, velocity, goal / 0.05], dim=1)  # numbers of about one
        state = softmpm.simulate(model, state, policy(seen)[None], model.params(), substeps=substeps)
        missed.append((softmpm.displacement(model, state)[:, tip, 1].mean(1) - goal[:, 0]).square())
    return torch.stack(missed), state


optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
for iteration in range(iterations):
    goal = 0.08 * torch.rand(worlds, 1, device=model.device) - 0.04  # height above rest [m]
    loss = episode(goal)[0][control_steps // 2 :].mean() / 0.01**2
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    print(f"{iteration}: {10 * loss.sqrt().item():.1f} mm from the goals, root mean square")
with torch.no_grad():
    goal = torch.linspace(-0.04, 0.04, worlds, device=model.device)[:, None]
    missed, end = episode(goal)
print(f"on a row of goals: {1000 * missed[-1].mean().sqrt().item():.1f} mm, root mean square")
shown = [0, worlds // 3, 2 * worlds // 3, worlds - 1]
figure = softmpm.show(model, end, world=shown, colour="strain")
for axes, k in zip(figure.axes, shown, strict=False):
    axes.axhline(0.15 + goal[k].item(), color="red", linewidth=1)  # the goal
figure.savefig("worlds.png", dpi=110)
