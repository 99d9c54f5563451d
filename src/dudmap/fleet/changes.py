"""Changes between two visits: things that appeared, disappeared, moved, or got other colours."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh, with_faces
from dudmap.fleet.change_colors import SOLID, recolored_pieces
from dudmap.fleet.change_evidence import UNKNOWN, Evidence, Visit, evidence, surface_tree
from dudmap.fleet.change_motion import LEAST_FIT, Body, Motion, motion_between
from dudmap.fleet.change_objects import (
    Piece,
    assembled,
    connected,
    denied_pieces,
    gap_between,
    is_certain,
    is_part,
    joined,
)
from dudmap.fleet.map_samples import transformed
from dudmap.io.exporting.gravity import Floor, fitted, floor_height, level_normal

Array = NDArray[np.float64]
ON_SURFACE = 0.02
"""Gap to a change, metres, of its residue in other colours."""
LEAST_UNKNOWN = 0.25
"""Smallest listed surface of only one visit, square metres."""


@dataclass(frozen=True, eq=False)
class Change:
    """A changed thing, in the frame of the earlier visit.

    Attributes:
        kind: appeared, disappeared, moved, recoloured, or unknown (only one visit saw it).
        before, after: Surface in either visit, or None.
        confidence: 0..1, share of surface that agrees with the kind.
    """

    kind: str
    before: Piece | None
    after: Piece | None
    confidence: float
    motion: Motion | None = None

    @property
    def points(self) -> Array:
        """Present or former surface (n, 3), metres."""
        piece = self.after if self.after is not None else self.before
        assert piece is not None
        return piece.points

    @property
    def box(self) -> Array:
        """Lower and upper corner (2, 3), metres."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])

    def tree(self) -> dict[str, Any]:
        """Values for a JSON file."""
        box, area = self.box, max(piece.area for piece in (self.before, self.after) if piece is not None)
        out: dict[str, Any] = {
            "kind": self.kind, "centre": box.mean(axis=0).round(4).tolist(), "box": box.round(4).tolist(),
            "volume": round(float(np.prod(box[1] - box[0])), 6), "area": round(area, 4),
            "confidence": round(self.confidence, 3),
        }  # fmt: skip
        if self.before is not None and self.after is not None:
            out["box_before"] = self.before.box.round(4).tolist()
        if self.motion is not None:
            T, sigma = self.motion.T_after_before, self.motion.sigma
            centre = self.before.box.mean(axis=0) if self.before is not None else np.zeros(3)
            distance = float(np.linalg.norm(T[:3, :3] @ centre + T[:3, 3] - centre))
            turn = float(np.degrees(se3.rotation_angle(T)))
            out |= {
                "T_after_before": T.tolist(), "distance": round(distance, 4), "distance_sigma": round(sigma[0], 4),
                "turn_deg": round(turn, 2), "turn_sigma_deg": round(float(np.degrees(sigma[1])), 2),
            }  # fmt: skip
            out |= {} if self.motion.ambiguous is None else {"ambiguous": self.motion.ambiguous}
        return out


def find_changes(before: Visit, after: Visit, min_size: float = 0.1) -> tuple[list[Change], tuple[Evidence, Evidence]]:
    """All changes of at least ``min_size`` (m), largest first, then unknown surface, and the evidence of both
    visits."""
    found = evidence(before, after), evidence(after, before)
    voxel = max(before.volume.voxel_size, after.volume.voxel_size)
    missing, new = (denied_pieces(one, voxel, min_size) for one in found)
    up = vertical(before)
    out = _moved((before, after), found, (missing, new), min_size, up) if missing and new else []
    for kind, pieces, one, own in (("disappeared", missing, found[0], before), ("appeared", new, found[1], after)):
        for piece in assembled([p for p in pieces if is_certain(p, one, min_size)], own, up):
            sides = (piece, None) if kind == "disappeared" else (None, piece)
            out.append(Change(kind, *sides, _confidence(piece, one)))
    painted = [recolored_pieces(one, voxel, min_size, solid) for one, solid in zip(found, (0.0, SOLID), strict=True)]
    for piece, share in painted[1]:  # both visits must agree, because their meshes have different vertices and edges
        touched = [part for change in out for part in (change.before, change.after) if part is not None]
        touches = [
            any(gap_between(piece, other) < ON_SURFACE + voxel for other in others)
            for others in ([other for other, _ in painted[0]], touched)
        ]
        if touches == [True, False]:  # colours left at the border of another change
            out.append(Change("recoloured", None, piece, share))
    out.sort(key=lambda change: -len(change.points))
    return out + _unknown(found, voxel), found


def _moved(
    visits: tuple[Visit, Visit],
    found: tuple[Evidence, Evidence],
    pieces: tuple[list[Piece], list[Piece]],
    size: float,
    up: Array,
) -> list[Change]:
    """Match pairs of pieces that are one thing, best first; remove them from ``pieces``."""
    offered = [
        [(p, Body.of(one, p), is_certain(p, one, size)) for p in side] for side, one in zip(pieces, found, strict=True)
    ]
    motions = list[tuple[Motion, Piece, Piece]]()
    for old, missing, old_certain in offered[0]:
        for now, new, now_certain in offered[1]:
            near = gap_between(old, now) < max(old.length, now.length)  # a distant fragment may belong to any thing
            tried = (old_certain and now_certain) or ((old_certain or now_certain) and near)
            motion = motion_between(*visits, missing, new, up) if tried else None
            if motion is not None:
                motions.append((motion, old, now))
    out: list[Change] = []
    surfaces = [surface_tree(visit.mesh.vertices) for visit in visits[::-1]] if motions else []
    taken = [np.zeros(len(one.state), bool) for one in found]
    for motion, *firsts in sorted(motions, key=lambda row: -row[0].explained):
        if any(used[first.vertices].any() for used, first in zip(taken, firsts, strict=True)):
            continue
        T, things = motion.T_after_before, list[Piece]()
        for side, (first, one, own, there, tree) in enumerate(
            zip(firsts, found, visits, visits[::-1], surfaces, strict=True)
        ):
            left = [p for p in pieces[side] if not np.isin(p.vertices[0], first.vertices)]
            shares = [_after_motion(p, one, there, T if side == 0 else se3.inverse(T), tree) for p in left]
            parts = [p for p, (on, hangs) in zip(left, shares, strict=True) if on > 0.5 and hangs < 1 - LEAST_FIT]
            thing = joined([first, *parts])
            parts += [
                p
                for p, (_, hangs) in zip(left, shares, strict=True)
                if p not in parts and (p.area < thing.area or hangs < 1 - LEAST_FIT) and is_part(p, thing, own)
            ]
            things.append(joined([first, *parts]))
            taken[side][things[-1].vertices] = True
            pieces[side][:] = [p for p in left if p not in parts]
        out.append(Change("moved", things[0], things[1], motion.fit, motion))
    return out


def vertical(visit: Visit) -> Array:
    """Vertical unit vector (3,): of level surfaces, else of the held camera."""
    held = -visit.keyframes[:, :3, 1].mean(axis=0)
    held /= np.linalg.norm(held)
    some = visit.mesh.faces[:: max(1, len(visit.mesh.faces) // 20_000)]
    mesh = replace(visit.mesh, faces=some)
    level = level_normal(mesh, held)
    height = None if level is None else floor_height(mesh, level)
    return held if level is None or height is None else fitted(mesh, Floor(level, height)).up


def _after_motion(piece: Piece, found: Evidence, there: Visit, T: Array, tree: KDTree) -> tuple[float, float]:
    points, limit = transformed(T, piece.points), float(np.median(found.tolerance[piece.vertices]))
    on, samples = tree.query(points)[0] < limit, there.sample(points)
    return float(on.mean()), float((~on & samples.is_free(limit)).mean())


def _confidence(piece: Piece, found: Evidence) -> float:
    share = found.tolerance[piece.vertices] / np.maximum(found.gap[piece.vertices], 1e-6)
    return float(np.clip(1 - np.median(share) ** 2, 0, 1))


def _unknown(found: Sequence[Evidence], voxel: float) -> list[Change]:
    out = []
    for number, one in enumerate(found):
        pieces = [p for p in connected(one, one.state == UNKNOWN, 4 * voxel) if p.area > LEAST_UNKNOWN]
        out += [Change("unknown", None if number else p, p if number else None, 1.0) for p in pieces]
    return out


def mesh_of(change: Change, found: tuple[Evidence, Evidence]) -> Mesh:
    """Present or former surface of a change."""
    one, piece = (found[1], change.after) if change.after is not None else (found[0], change.before)
    assert piece is not None
    chosen = np.zeros(len(one.state), bool)
    chosen[piece.vertices] = True
    return with_faces(one.mesh, np.all(chosen[one.mesh.faces], axis=1))
