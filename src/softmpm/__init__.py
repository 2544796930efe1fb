"""softmpm: differentiable simulation of soft robots.

A scene (what a person designs) is built into a model (what is fixed on a device); ``simulate`` advances states of it and is
differentiable in the start, the activation and the material:

    model = softmpm.build(scene)
    end = softmpm.simulate(model, model.rest(), activation, model.params(), substeps=20)
"""

from softmpm.alarms import Alarms, Failures
from softmpm.autograd import rasterize, simulate
from softmpm.building import StabilityWarning, build
from softmpm.cuda_graph import Graph
from softmpm.errors import UnstableError, noted
from softmpm.forces import clamp_forces, contact_forces
from softmpm.inputs import QUANTITIES, Inputs, Quantity
from softmpm.model import Model
from softmpm.pictures.figure import show
from softmpm.pictures.film import to_video
from softmpm.quantities import (
    body_mean,
    center_of_mass,
    displacement,
    elastic_energy,
    gravitational_energy,
    green_strain,
    kinetic_energy,
    mean_velocity,
    momentum,
    von_mises_strain,
)
from softmpm.recording.fibres import fibre_strokes
from softmpm.recording.reader import Recording
from softmpm.recording.rerun_export import to_rerun
from softmpm.recording.writer import Recorder
from softmpm.scene import presets
from softmpm.scene.actuators import Muscle, Pressure
from softmpm.scene.file import load_scene, save_scene
from softmpm.scene.materials import BarrierCorotated, FixedCorotated, NeoHookean, StableNeoHookean
from softmpm.scene.neighbours import neighbour_pairs
from softmpm.scene.outline import Outline
from softmpm.scene.polygons import inside
from softmpm.scene.scene import Body, Grid, Particles, Scene, Wall
from softmpm.scene.shapes import ball, box, image, mesh, polygons
from softmpm.stability import StableDt, stable_dt
from softmpm.state import ContactForces, GridField, Low, Nodal, Params, State, SurfaceState
from softmpm.trajectories import Trajectory, trajectory
from softmpm.warp_api import step
from softmpm.warp_arrays import WarpSolid, WarpState, torch_state, warp_solid, warp_state
from softmpm.warp_nodal import WarpNodal

__version__ = "0.1.0"

__all__ = [
    "QUANTITIES",
    "Alarms",
    "BarrierCorotated",
    "Body",
    "ContactForces",
    "Failures",
    "FixedCorotated",
    "Graph",
    "Grid",
    "GridField",
    "Inputs",
    "Low",
    "Model",
    "Muscle",
    "NeoHookean",
    "Nodal",
    "Outline",
    "Params",
    "Particles",
    "Pressure",
    "Quantity",
    "Recorder",
    "Recording",
    "Scene",
    "StabilityWarning",
    "StableDt",
    "StableNeoHookean",
    "State",
    "SurfaceState",
    "Trajectory",
    "UnstableError",
    "Wall",
    "WarpNodal",
    "WarpSolid",
    "WarpState",
    "ball",
    "body_mean",
    "box",
    "build",
    "center_of_mass",
    "clamp_forces",
    "contact_forces",
    "displacement",
    "elastic_energy",
    "fibre_strokes",
    "gravitational_energy",
    "green_strain",
    "image",
    "inside",
    "kinetic_energy",
    "load_scene",
    "mean_velocity",
    "mesh",
    "momentum",
    "neighbour_pairs",
    "noted",
    "polygons",
    "presets",
    "rasterize",
    "save_scene",
    "show",
    "simulate",
    "stable_dt",
    "step",
    "to_rerun",
    "to_video",
    "torch_state",
    "trajectory",
    "von_mises_strain",
    "warp_solid",
    "warp_state",
]


def __dir__() -> list[str]:
    return __all__
