"""Free vibrations of small amplitude: a bar that is free or held at one end, and a disc that breathes."""

import math

import numpy as np

import softmpm

from . import exact
from .running import Simulation, result, scene_of
from .statics import held

YOUNG, DENSITY = 1e5, 1000.0


def bar(kind: str, cells: int, per_cell: int, *, clamped: bool) -> dict:
    """Lowest longitudinal frequency of a bar of so many cells of length and two across, without Poisson's effect."""
    length, h = 1.0, 1.0 / cells
    begin = plane = 3 * h
    walls = []
    if clamped:
        plane, begin, wall = held(kind, 0, h, 2)
        walls = [wall]
    shape = softmpm.box((begin, 3 * h), (plane + length, 5 * h), spacing=h / per_cell)
    material = softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=0.0)
    one = Simulation(scene_of(h, shape, material, walls=walls, step=0.5), kind)
    x = one.model.exact_positions[:, 0] - plane
    wave = math.pi / length * (0.5 if clamped else 1.0)
    mode = np.zeros_like(one.model.exact_positions)
    mode[:, 0] = np.where(x > 0, np.sin(wave * x), 0.0) if clamped else np.cos(wave * x)
    speed = math.sqrt(YOUNG / DENSITY)
    found = one.frequency(mode, 1e-5 * speed, wave * speed)
    return result(one, (found, 0.0), wave * speed)


def disc(kind: str, cells: int, per_cell: int) -> dict:
    """Breathing frequency of a free disc of the radius 1/4, in plane strain, with so many cells per unit of length."""
    radius, poisson, h = 0.25, 0.3, 1.0 / cells
    center = (math.ceil(0.25 * cells) + 3.25) * h
    shape = softmpm.ball((center, center), radius, spacing=h / per_cell, cut_cells=True)
    material = softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=poisson)
    one = Simulation(scene_of(h, shape, material, step=0.5), kind)
    arms = one.model.exact_positions - center
    r = np.linalg.norm(arms, axis=1, keepdims=True)
    root = exact.breathing(poisson)
    bulk = YOUNG * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    speed = math.sqrt(bulk / DENSITY)
    mode = np.vectorize(exact.bessel)(1, root * r / radius) * arms / np.maximum(r, 1e-12)
    found = one.frequency(mode, 1e-5 * speed, root * speed / radius)
    return result(one, (found, 0.0), root * speed / radius)
