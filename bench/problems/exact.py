"""Exact answers of the problems: beams, bars, a column, a disc that breathes, and Hertz' contact."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Section(NamedTuple):
    """Stiffness of a beam's section."""

    bending: float
    """E I [N m²]."""
    axial: float
    """E A [N]."""
    shear: float
    """κ G A [N], κ = 5/6."""


def section(young: float, poisson: float, height: float, width: float | None) -> Section:
    """Of a rectangle, or per unit of depth in plane strain if ``width`` is None."""
    stiffness = young / (1 - poisson**2) if width is None else young
    area = height * (1.0 if width is None else width)
    shear = 5 / 6 * young / (2 * (1 + poisson)) * area
    return Section(stiffness * area * height**2 / 12, stiffness * area, shear)


def tip_of_beam(
    weight: float, length: float, of: Section, steps: int = 1000, softening: float = 0.0
) -> float:
    """Sinking of the tip [m] of a geometrically exact (Reissner) cantilever under its weight per length [N/m], by shooting.

    The section has the moment E I κ (1 − softening κ²); ``softening`` [m²] is 0 for a linear one.
    """

    def curvature(moment: float) -> float:
        linear = bent = moment / of.bending
        for _ in range(30 if softening else 0):
            bent = linear / (1 - softening * bent**2)
        return bent

    def slope(s: float, state: np.ndarray) -> np.ndarray:
        angle, moment, _ = state
        force = weight * (length - s)  # downward, on the section at s
        cos, sin = math.cos(angle), math.sin(angle)
        stretch, shear = 1 - force * sin / of.axial, -force * cos / of.shear
        x, y = stretch * cos - shear * sin, stretch * sin + shear * cos
        return np.array([curvature(moment), x * force, y])

    def end(moment: float) -> np.ndarray:
        state, h = np.array([0.0, moment, 0.0]), length / steps
        for k in range(steps):
            a = slope(k * h, state)
            b = slope((k + 0.5) * h, state + h / 2 * a)
            c = slope((k + 0.5) * h, state + h / 2 * b)
            d = slope((k + 1) * h, state + h * c)
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
        return state

    moment = root(lambda moment: end(moment)[1], -weight * length**2, 0.0, 50)
    return -end(moment)[2]


def softening_of_section(poisson: float, height: float, bent: float = 2.0) -> float:
    """Of a neo-Hookean strip in plane strain [m²], from its moment at the curvature ``bent`` [1/m].

    A strip bent to a ring has the stretches λ₁ = κ r and λ₂ = dr/dY at the radius r(Y), and dP₂/dY = κ P₁ in equilibrium. P₂ = 0 at
    both faces gives the inner radius, and the moment is ∫ P₁ r dY.
    """
    mu, lam = 1 / (2 * (1 + poisson)), poisson / ((1 + poisson) * (1 - 2 * poisson))

    def stress(one: float, other: float) -> float:
        return mu * (one - 1 / one) + lam * math.log(one * other) / one

    def through(inner: float, steps: int = 100) -> np.ndarray:
        state, h = np.array([inner, 0.0, 0.0]), height / steps

        def slope(state: np.ndarray) -> np.ndarray:
            along = state[0] * bent
            across = root(lambda s: stress(s, along) - state[1], 0.5, 2.0, 45)
            pulled = stress(along, across)
            return np.array([across, bent * pulled, pulled * state[0]])

        for _ in range(steps):  # midpoint rule
            state = state + h * slope(state + h / 2 * slope(state))
        return state

    inner = root(lambda r: through(r)[1], 1 / bent - 0.75 * height, 1 / bent - 0.25 * height, 30)
    linear = height**3 / 12 / (1 - poisson**2) * bent
    return float((1 - through(inner)[2] / linear) / bent**2)


def root(f: Callable[[float], float], low: float, high: float, halvings: int = 80) -> float:
    """Zero of an increasing function, by bisection."""
    for _ in range(halvings):
        middle = (low + high) / 2
        low, high = (middle, high) if f(middle) < 0 else (low, middle)
    return (low + high) / 2


def twist_of_bar(torque: float, length: float, side: float, shear_modulus: float) -> float:
    """Angle of the end [rad] of a square bar under a torque per length [N], after Saint-Venant: φ = t L² / (2 G J), J = 0.1406 a⁴."""
    odd = np.arange(1, 40, 2)
    factor = 1 / 3 - 64 / math.pi**5 * np.sum(np.tanh(odd * math.pi / 2) / odd**5)
    return torque * length**2 / (2 * shear_modulus * factor * side**4)


def column(height: np.ndarray, length: float, weight: float, mu: float, lam: float) -> np.ndarray:
    """Displacement [m] at these heights of a neo-Hookean column under its weight per volume [N/m³], in uniaxial strain.

    μ (F − 1/F) + λ ln F / F = −weight (L − X) at every X, integrated from the foot.
    """
    places, weights = np.polynomial.legendre.leggauss(20)

    def stretch(at: float) -> float:
        return root(lambda f: mu * (f - 1 / f) + lam * math.log(f) / f + weight * (length - at), 0.3, 1.5)

    def displacement(top: float) -> float:
        return sum(
            w * top / 2 * (stretch(top * (1 + s) / 2) - 1) for s, w in zip(places, weights, strict=True)
        )

    return np.array([displacement(top) for top in height])


def bessel(order: int, x: float) -> float:
    """J of whole order, by its series; for |x| ≤ 4."""
    return sum(
        (-1) ** k * (x / 2) ** (2 * k + order) / (math.factorial(k) * math.factorial(k + order))
        for k in range(20)
    )


def breathing(poisson: float) -> float:
    """ω R / c_p of a free disc in plane strain: x J₀(x) = (1 − 2ν)/(1 − ν) J₁(x), first root."""

    ratio = (1 - 2 * poisson) / (1 - poisson)
    return root(lambda x: ratio * bessel(1, x) - x * bessel(0, x), 1.0, 3.0)


class Hertz(NamedTuple):
    """Contact of a disc that rests on a smooth floor under its own weight, in plane strain."""

    pressure: float
    """Largest pressure p₀ [Pa]."""
    width: float
    """Half width b of the contact [m]."""
    sinking: float
    """Of the centre towards the floor [m]."""


def hertz(radius: float, young: float, poisson: float, weight: float) -> Hertz:
    """For small b/R; ``weight`` per volume [N/m³].

    The stress is Hertz' of the half plane, a uniform tension P/(2πR), and σ = ½ weight [−y, y; x] of the xx, yy and xy components,
    which leave the rest of the boundary without traction and carry the weight; the sinking is −∫ ε_yy from the floor to the centre.
    """
    load, stiffness = weight * math.pi * radius**2, young / (1 - poisson**2)
    width = math.sqrt(4 * load * radius / (math.pi * stiffness))
    p0 = 2 * load / (math.pi * width)
    places, weights = np.polynomial.legendre.leggauss(60)
    t = (1 + places) / 2  # z = R t⁴ resolves the contact
    z = radius * t**4
    across = -p0 * ((width**2 + 2 * z**2) / (width * np.hypot(width, z)) - 2 * z / width)
    along = -p0 * width / np.hypot(width, z)
    tension, y = load / (2 * math.pi * radius), z - radius
    across, along = across + tension - weight * y / 2, along + tension + weight * y / 2
    strain = (along - poisson / (1 - poisson) * across) / stiffness
    sinking = -np.sum(weights / 2 * strain * radius * 4 * t**3)
    return Hertz(p0, width, float(sinking))


class Sphere(NamedTuple):
    """Weightless sphere between two smooth plates."""

    force: float
    """Of each plate, 4/3 E* a³/R by Hertz [N]."""
    approach: float
    """Of each plate to the centre of the sphere [m]; a²/R for a half space."""


def sphere(radius: float, young: float, poisson: float, width: float, degrees: int = 2000) -> Sphere:
    """Sphere with Hertz' pressure on two circles of the radius ``width`` [m] about opposite poles, in linear elasticity.

    The pressure Σ pₙ Pₙ(cos θ) displaces the pole by the series of Lur'e (Three-dimensional problems of elasticity, 1964):
    uᵣ = R Σ Aₙ [(n + 1)(n − 2 + 4ν) − n (n² + 2n − 1 + 2ν)/(n − 1)], Aₙ = pₙ / (4 G (n² + n + 1 + (2n + 1) ν)) for even n.
    """
    ratio, stiffness, shear = width / radius, young / (1 - poisson**2), young / (2 * (1 + poisson))
    places, weights = np.polynomial.legendre.leggauss(degrees)
    angle = math.pi / 4 * (1 + places)  # r = a sin(angle) resolves the edge of the contact
    x = np.sqrt(1 - (ratio * np.sin(angle)) ** 2)
    pressure = 2 * ratio * stiffness / math.pi * np.cos(angle)
    share = weights * math.pi / 4 * ratio**2 * np.sin(angle) * np.cos(angle) / x * pressure
    before, here, sinking = np.ones_like(x), x, 0.0
    for n in range(0, degrees, 2):
        a = (2 * n + 1) * np.sum(share * before) / (4 * shear * (n * n + n + 1 + (2 * n + 1) * poisson))
        sinking -= a * ((n + 1) * (n - 2 + 4 * poisson) - n * (n * n + 2 * n - 1 + 2 * poisson) / (n - 1))
        before = ((2 * n + 3) * x * here - (n + 1) * before) / (n + 2)
        here = ((2 * n + 5) * x * before - (n + 2) * here) / (n + 3)
    return Sphere(4 / 3 * stiffness * width**3 / radius, radius * sinking)
