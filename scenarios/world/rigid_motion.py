"""How rigid bodies move between impacts: gravity, drift, rotation, and the correction of overlaps.

    x⁺ = x + v t ± ½ g t²                                                 a flight is exact
    q⁺ = q exp(e₁ ω₁ Δt/2) exp(e₂ …/2) exp(e₃ … Δt) exp(e₂ …/2) exp(e₁ …/2)         each turn exact, about one axis

A free body turns by the splitting of the rigid body's Hamiltonian into rotations about its principal axes, each of
which turns the body's angular momentum as well: angular momentum in space is kept to rounding, the energy error is
bounded and of second order in Δt (McLachlan 1993; Reich 1994). Where all moments are equal, or a hinge leaves one axis,
one exact turn is made.
"""

from __future__ import annotations

import math

import numpy as np

from scenarios.world.spheres import Ints
from solvers._jit import kernel
from solvers.solution import Floats

# Moments that differ by less than this share are equal: a ball's, a cube's.
EQUAL = 1e-12


def kick(velocity: Floats, inverse_mass: Floats, speed: Floats) -> Floats:
    """Velocities after gravity, shape (b, 6): all that falls gains `speed` downward [m/s], shape (b,)."""
    fallen = velocity.copy()
    fallen[:, 2] -= np.where(inverse_mass[:, 2] > 0.0, speed, 0.0)
    return fallen


def drift(
    position: Floats, orientation: Floats, velocity: Floats, mass: Floats, inverse_mass: Floats, duration: Floats,
    lift: Floats,
) -> None:  # fmt: skip
    """Move all bodies by x = v t + lift, in place; spins change as torque-free bodies' do.

    Args:
        position: centers of mass [m], shape (b, 3).
        orientation: quaternions, shape (b, 4).
        velocity: (v, ω), shape (b, 6).
        mass: shape (b, 6).
        inverse_mass: of what moves, shape (b, 6).
        duration: of each body [s], shape (b,).
        lift: of what falls, up along z [m], shape (b,): ½ g t² where v is the speed at the end of a fall.
    """
    _drift(position, orientation, velocity, mass, inverse_mass, duration, lift)


def push_apart(body: Ints, normal_rows: Floats, wanted: Floats, inverse_mass: Floats, sweeps: int) -> Floats:
    """Smallest displacements that take overlaps away, shape (b, 6), by projected Gauss-Seidel.

        0 <= λ  complementary to  J Δq - wanted >= 0

    Args:
        body: of each contact, shape (m, 2).
        normal_rows: blocks of J of both bodies, shape (m, 2, 6).
        wanted: by how much each gap should grow [m]; < 0 is how much it may shrink; shape (m,).
        inverse_mass: of what moves, shape (b, 6).
        sweeps: how many.
    """
    return _push_apart(body, normal_rows, wanted, inverse_mass, sweeps)


def displace(position: Floats, orientation: Floats, shift: Floats) -> None:
    """Move bodies by displacements and small rotations about their principal axes, shape (b, 6), in place."""
    _displace(position, orientation, shift)


@kernel
def _turn(orientation: Floats, b: int, x: float, y: float, z: float) -> None:
    """Turn a body about an axis in its own frame by the vector's length [rad], exactly."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return
    s = math.sin(0.5 * angle) / angle
    pw = math.cos(0.5 * angle)
    px = s * x
    py = s * y
    pz = s * z
    w = orientation[b, 0]
    i = orientation[b, 1]
    j = orientation[b, 2]
    k = orientation[b, 3]
    qw = w * pw - i * px - j * py - k * pz
    qi = w * px + i * pw + j * pz - k * py
    qj = w * py - i * pz + j * pw + k * px
    qk = w * pz + i * py - j * px + k * pw
    length = math.sqrt(qw * qw + qi * qi + qj * qj + qk * qk)
    orientation[b, 0] = qw / length
    orientation[b, 1] = qi / length
    orientation[b, 2] = qj / length
    orientation[b, 3] = qk / length


@kernel
def _turn_about(orientation: Floats, velocity: Floats, mass: Floats, b: int, axis: int, step: float) -> None:
    """Turn a body about one principal axis, and its angular momentum back, so that it stays the same in space."""
    angle = velocity[b, 3 + axis] * step
    _turn(
        orientation, b,
        angle if axis == 0 else 0.0, angle if axis == 1 else 0.0, angle if axis == 2 else 0.0,
    )  # fmt: skip
    one = 3 + (axis + 1) % 3
    other = 3 + (axis + 2) % 3
    along = mass[b, one] * velocity[b, one]
    across = mass[b, other] * velocity[b, other]
    c = math.cos(angle)
    s = math.sin(angle)
    velocity[b, one] = (c * along + s * across) / mass[b, one]
    velocity[b, other] = (c * across - s * along) / mass[b, other]


@kernel
def _drift(
    position: Floats, orientation: Floats, velocity: Floats, mass: Floats, inverse_mass: Floats, duration: Floats,
    lift: Floats,
) -> None:  # fmt: skip
    for b in range(velocity.shape[0]):
        step = duration[b]
        if step == 0.0:
            continue
        if inverse_mass[b, 0] > 0.0:
            for axis in range(3):
                position[b, axis] += step * velocity[b, axis]
            position[b, 2] += lift[b]
        free = 0
        for axis in range(3):
            if inverse_mass[b, 3 + axis] > 0.0:
                free += 1
        if free == 0:
            continue
        smallest = min(mass[b, 3], min(mass[b, 4], mass[b, 5]))
        largest = max(mass[b, 3], max(mass[b, 4], mass[b, 5]))
        if free == 1 or largest - smallest <= EQUAL * largest:
            _turn(orientation, b, step * velocity[b, 3], step * velocity[b, 4], step * velocity[b, 5])
            continue
        for axis in range(2):
            _turn_about(orientation, velocity, mass, b, axis, 0.5 * step)
        _turn_about(orientation, velocity, mass, b, 2, step)
        for axis in range(1, -1, -1):
            _turn_about(orientation, velocity, mass, b, axis, 0.5 * step)


@kernel
def _along(body: Ints, i: int, blocks: Floats, shift: Floats) -> float:
    """One row times displacements."""
    total = 0.0
    for side in range(2):
        owner = body[i, side]
        if owner < shift.shape[0]:
            for k in range(6):
                total += blocks[side, k] * shift[owner, k]
    return total


@kernel
def _push_apart(body: Ints, normal_rows: Floats, wanted: Floats, inverse_mass: Floats, sweeps: int) -> Floats:
    movable = inverse_mass.shape[0]
    shift = np.zeros((movable, 6))
    m = wanted.size
    push = np.zeros(m)
    weight = np.zeros(m)
    for i in range(m):
        for side in range(2):
            owner = body[i, side]
            if owner < movable:
                for k in range(6):
                    weight[i] += normal_rows[i, side, k] ** 2 * inverse_mass[owner, k]
    for _ in range(sweeps):
        for i in range(m):
            blocks = normal_rows[i]
            change = max((wanted[i] - _along(body, i, blocks, shift)) / weight[i], -push[i])
            push[i] += change
            for side in range(2):
                owner = body[i, side]
                if owner < movable:
                    for k in range(6):
                        shift[owner, k] += inverse_mass[owner, k] * change * blocks[side, k]
    return shift


@kernel
def _displace(position: Floats, orientation: Floats, shift: Floats) -> None:
    for b in range(shift.shape[0]):
        for axis in range(3):
            position[b, axis] += shift[b, axis]
        _turn(orientation, b, shift[b, 3], shift[b, 4], shift[b, 5])
