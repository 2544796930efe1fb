"""A gradient on a wp.Tape, for programs written in Warp: a throw is aimed off a wall. Leaves warp_tape.png."""

import sys

import matplotlib.pyplot as plt
import numpy as np
import warp as wp

import softmpm

iterations, substeps = 5 if "--quick" in sys.argv else 10, 180
cell, target = 1 / 40, wp.vec2(0.5, 0.3)  # [m]
ball = softmpm.ball((0.2, 0.2), 0.08, spacing=cell / 2)
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=(41, 31), spacing=cell),
    bodies=[softmpm.Body(ball, softmpm.NeoHookean(density=1000.0, young=2e4))],
    walls=[softmpm.Wall(normal=(-1.0, 0.0), offset=-0.85)],  # on the right
    gravity=(0.0, -9.81),
    dt=0.002,
)
model = softmpm.build(scene)


@wp.kernel
def throw(velocity: wp.array[wp.vec2], v: wp.array2d[wp.vec2]):
    v[0, wp.tid()] = velocity[0]  # the same for all particles of world 0


@wp.kernel
def loss_of(base: wp.array2d[wp.vec2i], fx: wp.array2d[wp.vec2], target: wp.vec2, loss: wp.array[float]):
    p = wp.tid()  # a position is stored as a node and the distance from it in cells
    away = wp.static(cell) * (wp.vec2(float(base[0, p][0]), float(base[0, p][1])) + fx[0, p]) - target
    wp.atomic_add(loss, 0, wp.dot(away, away) / float(base.shape[1]))


velocity = wp.array([(2.4, 1.8)], dtype=wp.vec2, requires_grad=True)  # [m/s]
solid = softmpm.warp_solid(model, requires_grad=True)
states = [softmpm.warp_state(model, requires_grad=True) for _ in range(substeps + 1)]  # all, for the tape
errors, (figure, axes) = [], plt.subplots(figsize=(7, 4), layout="constrained")
for iteration in range(iterations):
    loss = wp.zeros(1, dtype=float, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(throw, dim=len(ball), inputs=[velocity], outputs=[states[0].v])
        for k in range(substeps):
            softmpm.step(model, states[k], states[k + 1], solid, substep=k, tape=tape)
        wp.launch(loss_of, len(ball), [states[-1].base, states[-1].fx, target], [loss])
    solid.raise_failure(model, states[-1])  # a step does not wait for the device to report one
    tape.backward(loss)
    tried, gradient = velocity.numpy()[0].copy(), velocity.grad.numpy()[0].copy()
    path = np.array([softmpm.torch_state(model, state).x[0].mean(0).tolist() for state in states[::5]])
    errors.append(1000 * np.linalg.norm(path[-1] - target))
    print(f"v = {tried} m/s: {errors[-1]:.1f} mm off, gradient {gradient}")
    axes.plot(*path.T, color=plt.cm.viridis(iteration / iterations))
    velocity.assign([tried - 4.0 * gradient])  # 1 / (2 t²) would be exact without the wall
    tape.zero()
softmpm.show(model, softmpm.torch_state(model, states[-1]), axes=axes)
axes.plot(*target, "rx", markersize=12)
axes.set(xlim=(0.1, 0.9), ylim=(0.1, 0.55))
figure.savefig("warp_tape.png", dpi=110)
