"""Data that the threads of a brick of particles anywhere read: the same in every substep of a control step."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, window
from softmpm.kernels.lagrangian.interpolation import sums
from softmpm.kernels.lagrangian.particle_force import particle_forces
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def seats(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    vec, Rest = types(spec.dim, spec.dtype).vec, rest(spec.dim, spec.dtype).Rest
    ParticleInputs, one, count = input_types(spec).ParticleInputs, particle_forces(spec), bricks.cell_count
    Given, given_to, windows = one.Given, one.given_to, window(bricks, bricks.threads)
    Window = windows.Window
    window_of = windows.window_of
    place_of = sums(spec.dim, spec.dtype, bricks, False).place_of

    @wp.struct
    class Occupant:
        """A particle in a slot of a row."""

        place: int  # -1 if there is none
        fx: vec
        given: Given

    @wp.struct
    class Seat:
        nodes: Window
        first: int  # rows of the brick
        last: int
        corner: int
        occupant: Occupant  # of the first row

    @wp.func
    def occupant_of(inside: Rest, inputs: ParticleInputs, world: int, row: int, slot: int) -> Occupant:
        out = Occupant()
        out.place = place_of(inside, row, slot)
        some = wp.max(out.place, 0)
        out.fx = inside.fraction[some]
        out.given = given_to(inputs, world, some)
        return out

    @wp.func
    def seat_of(inside: Rest, inputs: ParticleInputs, world: int, brick: int, lane: int) -> Seat:
        out = Seat()
        out.nodes = window_of(inside.window, brick, lane)
        out.first = inside.rows[brick]
        out.last = inside.rows[brick + 1]
        out.corner = inside.corners[brick, lane % count]
        out.occupant = occupant_of(inside, inputs, world, out.first, lane)
        return out

    return SimpleNamespace(Seat=Seat, occupant_of=occupant_of, seat_of=seat_of)
