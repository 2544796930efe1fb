"""A disc of jelly falls onto a block: a recording, a film of it in MP4 or GIF, and a file for the Rerun viewer."""

import dataclasses
import math
import sys
from pathlib import Path

import softmpm

quick = "--quick" in sys.argv
cell = 0.02 if quick else 0.01  # [m]
seconds, period = 0.1 if quick else 0.8, 0.01

# Bodies that meet each other need the moving formulation, which is the default.
jelly = softmpm.NeoHookean(density=1000.0, young=2e4, poisson=0.4, viscosity=5.0)
lower = softmpm.box((0.30, 0.06), (0.46, 0.22), spacing=cell / 2)
upper = softmpm.ball((0.46, 0.34), 0.08, spacing=cell / 2, cut_cells=True)
scene = softmpm.Scene(
    grid=softmpm.Grid(shape=(round(1.0 / cell), round(0.5 / cell)), spacing=cell),
    bodies=[softmpm.Body(lower, jelly), softmpm.Body(upper, dataclasses.replace(jelly, young=4e4))],
    walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.06, friction=0.4)],
    gravity=(0.0, -9.81),
    dt=1e-6,
)
substeps = math.ceil(period / (0.4 * softmpm.stable_dt(scene)))
scene = dataclasses.replace(scene, dt=period / substeps)
model = softmpm.build(scene)

# The recorder writes each frame at once, so that a long run can be looked at while it goes on, and after a crash.
Path("film.h5").unlink(missing_ok=True)  # a recorder does not overwrite
state = model.rest()
with softmpm.Recorder("film.h5", model) as recorder, recorder.episode(iteration=0) as episode:
    episode.frame(0.0, state)
    for k in range(round(seconds / period)):
        state = softmpm.simulate(model, state, None, model.params(), substeps=substeps)
        episode.frame((k + 1) * period, state)

softmpm.to_video("film.h5", "film.gif", colour="strain", rate=0.25)  # a quarter of the speed
try:
    softmpm.to_video("film.h5", "film.mp4", colour="strain", rate=0.25)
except ImportError as error:
    print(error)  # MP4 needs a further package
softmpm.show(model, state, colour="strain").savefig("film.png", dpi=110)
print("View it with: rerun", softmpm.to_rerun("film.h5"))
