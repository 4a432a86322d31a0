"""Contacts between rigid bodies: MuJoCo's collision detection alone, behind arrays.

MuJoCo is given the shapes and poses of a scene and asked for contacts nearer than a margin; nothing of its dynamics is
used. A contact's normal is the direction between the closest points. It is unique for convex parts that do not overlap
yet, also at edges and apexes, and parts are seen while there still is a gap between them. Within 6° of the normal of
a face it is the face's. Flat faces get up to four contacts at the corners of what they share.
Boxes are given as hulls: for hulls MuJoCo finds the same four contacts however little two faces are tilted, for its
boxes four, six, eight or one (trial: 60 random tilts of 1e-3 of two cubes that lie on one another).

Where a body is a union, a neighboring part may answer with a corner that lies inside of the whole (a ball that rolls
over a seam). Of contacts of the same two bodies that lie together and push the same way only the nearest is kept.

Source: Todorov 2012 (MuJoCo); its hulls are kept in single precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.world.edge_contacts import ends_of_edges
from scenarios.world.obstacle import Obstacle
from scenarios.world.rigid_bodies import RigidBodies
from scenarios.world.rotation import multiply, rotation_matrix
from scenarios.world.shapes import Kind, Part, extra
from scenarios.world.spheres import Ints
from solvers import ProblemError
from solvers._jit import kernel
from solvers.solution import Floats

Keys = npt.NDArray[np.int64]

# Contacts of one pair of convex parts are one where they are nearer than this share of the thinner body's thickness.
SAME_POINT = 1e-3
# Contacts of one pair of bodies through different parts are one where they are nearer than this share of it ...
SEAM = 0.1
# ... and their normals include less than 30 degrees.
SEAM_COSINE = 0.866
# Corners whose heights over the other body differ by less than this share of the thinnest half thickness are an edge's.
EDGE = 0.1
# MuJoCo's memory for contacts [bytes]: a contact takes some 600, a scene of 200 bodies has a few thousand.
MEMORY = 1 << 26
# Closest points are found to this length [m]; MuJoCo's own default is 1e-6.
CLOSEST = 1e-10


@dataclass(frozen=True)
class RigidContacts:
    """Contacts of rigid bodies, sorted by the parts that touch."""

    body: Ints
    """First and second body as `RigidBodies` numbers them, shape (m, 2)."""
    part: Keys
    """Which parts of them touch: the same number for the same pair of parts; shape (m,)."""
    point: Floats
    """Midway between the two surfaces [m], shape (m, 3)."""
    normal: Floats
    """Unit vector from the first to the second body, shape (m, 3)."""
    gap: Floats
    """Distance of the surfaces [m], < 0 where they overlap; shape (m,)."""

    @property
    def m(self) -> int:
        """Number of contacts."""
        return int(self.gap.size)

    def take(self, kept: npt.NDArray[np.intp] | npt.NDArray[np.bool_]) -> RigidContacts:
        """Some of the contacts."""
        return RigidContacts(self.body[kept], self.part[kept], self.point[kept], self.normal[kept], self.gap[kept])


class Collider:
    """Finds the contacts of a scene's bodies, wherever these are.

    Args:
        bodies: of the scene; positions and orientations of the fixed ones are read here, those of others later.
        obstacles: smooth fixed surfaces, seen by balls.

    Raises:
        ProblemError: MuJoCo is not installed.
    """

    def __init__(self, bodies: RigidBodies, obstacles: Sequence[Obstacle] = ()) -> None:
        mujoco = extra("mujoco")
        self._kinematics, self._collision = mujoco.mj_kinematics, mujoco.mj_collision
        self._full = int(mujoco.mjtWarning.mjWARN_CONTACTFULL)
        self._model, owners, parts = _model(mujoco, bodies)
        self._state = mujoco.MjData(self._model)
        self._owner = np.array(owners, dtype=np.int32)
        corners = [part.corners @ rotation_matrix(part.orientation).T + part.position for part in parts]
        self._corner = np.concatenate(corners)
        self._start = np.cumsum([0, *(len(points) for points in corners)]).astype(np.int32)
        self._position, self._orientation = bodies.position.copy(), bodies.orientation.copy()
        self._thinnest = min(shape.thickness for shape in bodies.shapes[: bodies.movable])
        self._obstacles = tuple(obstacles)
        self._bodies = bodies.count
        movable = bodies.shapes[: bodies.movable]
        self._balls = np.array([k for k, shape in enumerate(movable) if shape.is_ball], dtype=np.int32)
        self._radii = np.array([movable[k].radius for k in self._balls])
        surfaces = [shape.thickness for shape in bodies.shapes] + [np.inf] * len(self._obstacles)
        self._thickness = np.array(surfaces)
        self._many = np.array([len(shape.parts) > 1 for shape in bodies.shapes] + [True] * len(self._obstacles))

    def contacts(self, position: Floats, orientation: Floats, reach: float) -> RigidContacts:
        """All contacts with a gap of at most `reach`.

        Args:
            position: centers of mass of the movable bodies [m], shape (b, 3).
            orientation: quaternions of their principal axes, shape (b, 4).
            reach: largest gap [m], ≥ 0.

        Raises:
            ProblemError: there are more contacts than MuJoCo has memory for.
        """
        found = [self._between_bodies(position, orientation, reach)]
        if len(self._obstacles) and self._balls.size:
            centers = np.ascontiguousarray(position[self._balls])
            found += [self._with_obstacle(k, centers, reach) for k in range(len(self._obstacles))]
        contacts = found[0] if len(found) == 1 else _joined(found)
        contacts = contacts.take(np.argsort(contacts.part, kind="stable"))
        pair = contacts.body.min(axis=1).astype(np.int64) << 32 | contacts.body.max(axis=1)
        kept = _distinct(
            contacts.body, contacts.part, contacts.point, contacts.normal, contacts.gap,
            np.argsort(pair, kind="stable"), self._thickness, self._many,
        )  # fmt: skip
        contacts = contacts if kept.all() else contacts.take(kept)
        return self._with_ends(contacts, position, orientation, reach)

    def _with_ends(self, contacts: RigidContacts, position: Floats, orientation: Floats, reach: float) -> RigidContacts:
        """Both ends of what two edges share, where one contact stands for them."""
        new = np.append(True, contacts.part[1:] != contacts.part[:-1])[: contacts.m]
        single = np.flatnonzero(new & np.append(new[1:], True)[: contacts.m])
        if not single.size:
            return contacts
        self._position[: len(position)], self._orientation[: len(orientation)] = position, orientation
        alone = contacts.take(single)
        geometry = np.column_stack([alone.part >> 32, alone.part & 0xFFFFFFFF]).astype(np.int32)
        found, point, gap = ends_of_edges(
            alone.body, geometry, alone.normal, self._position, self._orientation, self._corner, self._start,
            EDGE * self._thinnest,
        )  # fmt: skip
        if not found.any():
            return contacts
        kept = np.ones(contacts.m, dtype=np.bool_)
        kept[single[found]] = False
        twice = np.repeat(np.flatnonzero(found), 2)
        ends = RigidContacts(
            alone.body[twice], alone.part[twice], point[found].reshape(-1, 3), alone.normal[twice], gap[found].ravel()
        )
        joined = _joined([contacts.take(kept), ends.take(ends.gap <= reach)])
        return joined.take(np.argsort(joined.part, kind="stable"))

    def _between_bodies(self, position: Floats, orientation: Floats, reach: float) -> RigidContacts:
        state = self._state
        pose = state.qpos.reshape(-1, 7)
        pose[:, :3], pose[:, 3:] = position, orientation
        # The margins of the two geometries are added; those of the bodies tell which of these are looked at at all.
        self._model.geom_margin[:] = self._model.body_margin[:] = 0.5 * reach
        self._kinematics(self._model, state)
        self._collision(self._model, state)
        if state.warning[self._full].number:
            raise ProblemError(f"bodies have more contacts than fit into {MEMORY >> 20} MB: do they overlap?")
        found = state.contact
        geometry = np.array(found.geom, dtype=np.int32).reshape(-1, 2)
        part = geometry[:, 0].astype(np.int64) << 32 | geometry[:, 1]
        normal = np.array(found.frame, dtype=np.float64).reshape(-1, 9)[:, :3]
        return RigidContacts(
            self._owner[geometry], part, np.array(found.pos, dtype=np.float64).reshape(-1, 3),
            np.ascontiguousarray(normal), np.array(found.dist, dtype=np.float64),
        )  # fmt: skip

    def _with_obstacle(self, number: int, centers: Floats, reach: float) -> RigidContacts:
        ball, point, normal, gap = self._obstacles[number].contacts(centers, self._radii, reach)
        body = np.empty((gap.size, 2), dtype=np.int32)
        body[:, 0], body[:, 1] = self._bodies + number, self._balls[ball]
        # Behind all geometries.
        part = np.int64(self._owner.size + number) << 32 | body[:, 1].astype(np.int64)
        # The point of the surface and not of the ball: the ball has its own half of the gap.
        return RigidContacts(
            body, part, np.ascontiguousarray(point, dtype=np.float64),
            np.ascontiguousarray(normal, dtype=np.float64), np.ascontiguousarray(gap, dtype=np.float64),
        )  # fmt: skip


def _joined(found: Sequence[RigidContacts]) -> RigidContacts:
    return RigidContacts(
        np.concatenate([contacts.body for contacts in found]),
        np.concatenate([contacts.part for contacts in found]),
        np.concatenate([contacts.point for contacts in found]),
        np.concatenate([contacts.normal for contacts in found]),
        np.concatenate([contacts.gap for contacts in found]),
    )


def _model(mujoco: Any, bodies: RigidBodies) -> tuple[Any, list[int], list[Part]]:
    """MuJoCo's model of the shapes, and the body and the part of each of its geometries."""
    spec = mujoco.MjSpec()
    spec.memory = MEMORY
    spec.option.ccd_tolerance = CLOSEST
    numbers: dict[str, tuple[int, Part]] = {}
    for k, shape in enumerate(bodies.shapes):
        if k < bodies.movable:
            body = spec.worldbody.add_body(mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True)
            body.add_freejoint()
            position, orientation = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        else:
            body, position, orientation = spec.worldbody, bodies.position[k], bodies.orientation[k]
        for part in shape.parts:
            name = f"{k}-{len(numbers)}"
            numbers[name] = k, part
            _add(mujoco, spec, body, name, part, position, orientation)
    model = spec.compile()
    named = [numbers[model.geom(g).name] for g in range(model.ngeom)]
    return model, [k for k, _ in named], [part for _, part in named]


def _add(mujoco: Any, spec: Any, body: Any, name: str, part: Part, position: Floats, orientation: Floats) -> None:
    """Add one part to a body of MuJoCo's, in whose frame the shape's own frame is placed."""
    kinds = mujoco.mjtGeom
    kind = {
        Kind.BALL: kinds.mjGEOM_SPHERE, Kind.BOX: kinds.mjGEOM_MESH, Kind.CAPSULE: kinds.mjGEOM_CAPSULE,
        Kind.CYLINDER: kinds.mjGEOM_CYLINDER, Kind.HALF_SPACE: kinds.mjGEOM_PLANE, Kind.HULL: kinds.mjGEOM_MESH,
    }[part.kind]  # fmt: skip
    # A plane without half sizes has no end; its third number is the spacing of a grid that is never drawn.
    size = [0.0, 0.0, 1.0] if part.kind is Kind.HALF_SPACE else [*part.size, 0.0, 0.0][:3]
    geometry = body.add_geom(
        name=name, type=kind, size=size,
        pos=position + rotation_matrix(orientation) @ part.position, quat=multiply(orientation, part.orientation),
    )  # fmt: skip
    if kind == kinds.mjGEOM_MESH:
        spec.add_mesh(name=name, uservert=part.corners.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        geometry.meshname = name


@kernel
def _distinct(
    body: Ints, part: Keys, point: Floats, normal: Floats, gap: Floats, order: npt.NDArray[np.intp], thickness: Floats,
    many: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:  # fmt: skip
    """Which contacts to keep: of several that are one, the nearest; `order` sorts them by their two bodies."""
    m = gap.size
    kept = np.ones(m, np.bool_)
    for first in range(m):
        i = order[first]
        low = min(body[i, 0], body[i, 1])
        high = max(body[i, 0], body[i, 1])
        thin = min(thickness[low], thickness[high])
        seams = many[low] or many[high]
        for second in range(first + 1, m):
            j = order[second]
            if min(body[j, 0], body[j, 1]) != low or max(body[j, 0], body[j, 1]) != high:
                break
            same = part[i] == part[j]
            if not kept[j] or not (same or seams):
                continue
            limit = (SAME_POINT if same else SEAM) * thin
            square = 0.0
            cosine = 0.0
            for axis in range(3):
                square += (point[i, axis] - point[j, axis]) ** 2
                cosine += normal[i, axis] * normal[j, axis]
            # MuJoCo sorts two parts by their kinds: of other parts of the same bodies the second may be the first.
            if body[j, 0] != body[i, 0]:
                cosine = -cosine
            if square < limit * limit and cosine > SEAM_COSINE:
                if gap[j] < gap[i]:
                    kept[i] = False
                    break
                kept[j] = False
    return kept
