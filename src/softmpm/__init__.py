"""softmpm: differentiable simulation of soft robots."""

from softmpm.autograd import rasterize, simulate
from softmpm.model import Model, build
from softmpm.scene import Body, FixedCorotated, Grid, Muscle, NeoHookean, Particles, Scene, Wall
from softmpm.state import GridField, Params, State
from softmpm.tape import WarpSolid, WarpState, step, torch_state, warp_solid, warp_state
from softmpm.watch import UnstableError
