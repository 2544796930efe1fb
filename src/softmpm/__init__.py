"""softmpm: differentiable simulation of soft robots.

A scene (what a person designs) is built into a model (what is fixed on a device); ``simulate`` advances states of it and is
differentiable in the start, the activation and the material:

    model = softmpm.build(scene)
    end = softmpm.simulate(model, model.rest(), activation, model.params(), substeps=20)
"""

from softmpm.alarms import Alarms, Failures
from softmpm.autograd import rasterize, simulate
from softmpm.graph import Graph
from softmpm.model import Model, build
from softmpm.playback import Recording
from softmpm.recording import Recorder
from softmpm.rerun_file import to_rerun
from softmpm.scene import (
    BarrierCorotated,
    Body,
    FixedCorotated,
    Grid,
    Muscle,
    NeoHookean,
    Particles,
    Scene,
    Wall,
)
from softmpm.shapes import ball, box, image, mesh
from softmpm.stability import StabilityWarning, StableDt, stable_dt
from softmpm.state import GridField, Low, Params, State
from softmpm.tape import step
from softmpm.warp_arrays import WarpSolid, WarpState, torch_state, warp_solid, warp_state
from softmpm.watch import UnstableError

__version__ = "0.1.0"

__all__ = [
    "Alarms",
    "BarrierCorotated",
    "Body",
    "Failures",
    "FixedCorotated",
    "Graph",
    "Grid",
    "GridField",
    "Low",
    "Model",
    "Muscle",
    "NeoHookean",
    "Params",
    "Particles",
    "Recorder",
    "Recording",
    "Scene",
    "StabilityWarning",
    "StableDt",
    "State",
    "UnstableError",
    "Wall",
    "WarpSolid",
    "WarpState",
    "ball",
    "box",
    "build",
    "image",
    "mesh",
    "rasterize",
    "simulate",
    "stable_dt",
    "step",
    "to_rerun",
    "torch_state",
    "warp_solid",
    "warp_state",
]
