"""A small orthographic renderer: triangles and points into a depth buffer, shaded.

Fast enough for some hundred thousand triangles a view, and it needs no graphics hardware. The scene's frame is that of the
points (``table`` in the report); a view is a rotation whose rows are the picture's right, its up, and the direction towards
the viewer. Work is done at twice the resolution and averaged, which smooths the edges.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from rotaline.io.report.raster_kernels import draw_discs, finish

_EMPTY = np.iinfo(np.int64).max
_OVERSAMPLING = 2
_FAR_PX = 24.0  # edges to what is so far behind get no darker
_FRONT = np.array([0.72, 0.765, 0.81])
_BACK = np.array([0.80, 0.70, 0.60])


@dataclass(frozen=True, eq=False)
class View:
    """Orthographic view: rows of ``rotation`` are right, up, towards the viewer; the picture is centred on ``centre``.

    ``mm_per_px`` is the scale of the finished picture, ``size_px`` its (width, height).
    """

    rotation: Float[np.ndarray, "3 3"]
    centre: Float[np.ndarray, "3"]
    mm_per_px: float
    size_px: tuple[int, int]


def view_rotation(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """Rotation of a viewer at the azimuth about z (from x) and the elevation above the xy plane; z points up."""
    a, e = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def views_around(
    points: Float[np.ndarray, "n 3"], directions_deg: tuple[tuple[float, float], ...], size_px: tuple[int, int]
) -> tuple[View, ...]:
    """Views of the points from several (azimuth, elevation), all to the same scale and about the same centre.

    Points far away from the rest (the outermost 0.3 % on every side) do not shrink the picture.
    """
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        finite = np.zeros((1, 3))
    low, high = np.percentile(finite, [0.3, 99.7], axis=0)
    centre = (low + high) / 2
    core = finite[((finite >= low) & (finite <= high)).all(axis=1)] if len(finite) > 8 else finite
    core = core if len(core) else finite
    rotations = [view_rotation(*d) for d in directions_deg]
    scale = 1e-9
    for rotation in rotations:
        reach = np.abs((core - centre) @ rotation[:2].T).max(axis=0)
        scale = max(scale, 2.0 * reach[0] / (0.92 * size_px[0]), 2.0 * reach[1] / (0.92 * size_px[1]))
    return tuple(View(rotation, centre, float(scale), size_px) for rotation in rotations)


def render_points(
    points: Float[np.ndarray, "n 3"],
    colours: Float[np.ndarray, "n 3"],
    view: View,
    radius_px: float = 1.2,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw points as small discs, the nearest in front, with edges darkened where the depth jumps."""
    xyz, width, height = _to_pixels(points, view)
    xyz[~np.isfinite(colours).all(axis=1) | ~np.isfinite(xyz).all(axis=1)] = np.nan
    reach = radius_px * _OVERSAMPLING
    whole = int(np.ceil(reach))
    dv, du = np.mgrid[-whole : whole + 1, -whole : whole + 1]
    disc = np.stack([du, dv], axis=-1)[du * du + dv * dv <= reach * reach + 0.25]
    depth, which = np.empty((height, width)), np.empty((height, width), dtype=np.int64)
    draw_discs(xyz, disc, depth, which)
    return _finished(colours, which, depth, strength=0.9)


def render_mesh(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    views: Sequence[View],
    colours: Float[np.ndarray, "v 3"] | None = None,
) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Draw a mesh from several views with smooth shading.

    Without ``colours`` (of the vertices, 0 to 1), the outside is blue-grey and faces seen from their inner side are brownish. With
    them, the light is softer, so that a colour can be found in its scale.
    """
    finite = np.isfinite(vertices).all(axis=1)
    faces = triangles[finite[triangles].all(axis=1)]
    normals, face_normals = _normals(vertices, faces)
    return [_render_mesh(vertices, faces, normals, face_normals, view, colours) for view in views]


def picture_position(points: Float[np.ndarray, "n 3"], view: View) -> Float[np.ndarray, "n 3"]:
    """Column and row in the finished picture (px, pixel centres at whole numbers) and depth (mm, larger is nearer)."""
    right_up_near = (points - view.centre) @ view.rotation.T
    return np.stack(
        [
            right_up_near[:, 0] / view.mm_per_px + view.size_px[0] / 2 - 0.5,
            view.size_px[1] / 2 - 0.5 - right_up_near[:, 1] / view.mm_per_px,
            right_up_near[:, 2],
        ],
        axis=1,
    )


def hidden(
    points: Float[np.ndarray, "n 3"],
    vertices: Float[np.ndarray, "v 3"],
    view: View,
    reach_mm: float = 0.5,
    behind_mm: float = 2.5,
) -> Bool[np.ndarray, " n"]:
    """Which points a dense mesh hides: a vertex within ``reach_mm`` beside the point is ``behind_mm`` nearer to the viewer.

    On a surface that is seen obliquely the neighbours of a point are nearer, too: by less than that down to 12 deg.
    """
    at, mesh = ((p - view.centre) @ view.rotation.T for p in (points, vertices))
    return np.array(
        [
            bool((mesh[np.hypot(mesh[:, 0] - x, mesh[:, 1] - y) < reach_mm, 2] > near + behind_mm).any())
            for x, y, near in at
        ],
        dtype=bool,
    )


def _render_mesh(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    normals: Float[np.ndarray, "v 3"],
    face_normals: Float[np.ndarray, "t 3"],
    view: View,
    colours: Float[np.ndarray, "v 3"] | None,
) -> UInt8[np.ndarray, "h w 3"]:
    xyz, width, height = _to_pixels(vertices, view)
    buffer = np.full(width * height, _EMPTY, dtype=np.int64)
    edges, slopes, window = _set_up(xyz, faces, width, height)
    drawn = np.flatnonzero((window[:, 2] > 0) & (window[:, 3] > 0) & np.isfinite(slopes).all(axis=1))
    depths = xyz[faces, 2]
    low, high = (float(depths.min()), float(depths.max())) if len(faces) else (0.0, 1.0)
    for ids, nu, nv in _by_window(drawn, window):
        _fill(buffer, ids, nu, nv, edges, slopes, window, width, (low, high))
    seen = np.flatnonzero(buffer != _EMPTY)
    which = (buffer[seen] & 0xFFFFFFFF).astype(np.int64)
    weights = np.clip(_affine(edges[which], seen % width, seen // width), 0.0, None)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    depth = np.full(width * height, np.nan)
    depth[seen] = np.einsum("ij,ij->i", weights, depths[which])
    n = np.einsum("ij,ijk->ik", weights, normals[faces[which]]) @ view.rotation.T
    if colours is None:
        inner = face_normals[which] @ view.rotation[2] < 0.0
        colour = _shade(n, np.where(inner[:, None], _BACK, _FRONT), softness=0.0)
    else:
        colour = _shade(n, np.einsum("ij,ijk->ik", weights, colours[faces[which]]), softness=0.6)
    number = np.full(width * height, -1)
    number[seen] = np.arange(len(seen))
    return _finished(colour, number.reshape(height, width), depth.reshape(height, width), strength=0.35)


def _to_pixels(points: Float[np.ndarray, "n 3"], view: View) -> tuple[Float[np.ndarray, "n 3"], int, int]:
    """Column, row (of the enlarged picture; pixel centres at whole numbers) and depth (px, larger is nearer)."""
    width, height = view.size_px[0] * _OVERSAMPLING, view.size_px[1] * _OVERSAMPLING
    xyz = (points - view.centre) @ view.rotation.T * (_OVERSAMPLING / view.mm_per_px)
    xyz[:, 0] += width / 2 - 0.5
    xyz[:, 1] = height / 2 - 0.5 - xyz[:, 1]
    return xyz, width, height


def _quantised(z: Float[np.ndarray, " n"], low: float, high: float) -> Int[np.ndarray, " n"]:
    return (np.clip((high - z) / max(high - low, 1e-12), 0.0, 1.0) * (2**30)).astype(np.int64)


def _set_up(
    xyz: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"], width: int, height: int
) -> tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3"], Int[np.ndarray, "t 4"]]:
    """Per triangle: barycentric weights and depth as ``a u + b v + c``, and the window of pixel centres (u0, v0, nu, nv)."""
    p = xyz[faces]
    u, v, z = p[:, :, 0], p[:, :, 1], p[:, :, 2]
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    edges = np.empty((len(faces), 3, 3))
    with np.errstate(all="ignore"):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            edges[:, i, 0] = (v[:, j] - v[:, k]) / area
            edges[:, i, 1] = (u[:, k] - u[:, j]) / area
            edges[:, i, 2] = (u[:, j] * v[:, k] - u[:, k] * v[:, j]) / area
        slopes = np.einsum("tij,ti->tj", edges, z)
    first = np.ceil(np.stack([u.min(axis=1), v.min(axis=1)], axis=1)).clip(0, None)
    last = np.floor(np.stack([u.max(axis=1), v.max(axis=1)], axis=1)).clip(None, (width - 1, height - 1))
    window = np.concatenate([first, last - first + 1], axis=1).clip(-(2**31), 2**31).astype(np.int64)
    return edges, slopes, window


def _by_window(drawn: Int[np.ndarray, " d"], window: Int[np.ndarray, "t 4"]) -> list[tuple[np.ndarray, int, int]]:
    """Triangles grouped by the size of their window, rounded up to powers of two; large ones one by one."""
    groups = []
    sizes = 2 ** np.ceil(np.log2(window[drawn, 2:])).astype(np.int64)
    small = sizes.prod(axis=1) <= 1024
    for nu, nv in np.unique(sizes[small], axis=0):
        groups.append((drawn[small & (sizes[:, 0] == nu) & (sizes[:, 1] == nv)], int(nu), int(nv)))
    for t in drawn[~small]:
        groups.append((np.array([t]), int(window[t, 2]), int(window[t, 3])))
    return groups


def _fill(
    buffer: Int[np.ndarray, " p"],
    ids: Int[np.ndarray, " k"],
    nu: int,
    nv: int,
    edges: Float[np.ndarray, "t 3 3"],
    slopes: Float[np.ndarray, "t 3"],
    window: Int[np.ndarray, "t 4"],
    width: int,
    depth_range: tuple[float, float],
) -> None:
    """Put the triangles ``ids`` into the depth buffer (which is changed), testing nu x nv pixels each."""
    dv, du = (g.ravel() for g in np.mgrid[0:nv, 0:nu])
    chunk = max(1, 2_000_000 // len(du))
    for start in range(0, len(ids), chunk):
        part = ids[start : start + chunk]
        w = window[part]
        u, v = w[:, 0, None] + du, w[:, 1, None] + dv
        ok = (du < w[:, 2, None]) & (dv < w[:, 3, None])
        which, at = np.nonzero(ok)
        u, v, t = u[which, at], v[which, at], part[which]
        ok = (_affine(edges[t], u, v) >= -1e-9).all(axis=1)
        u, v, t = u[ok], v[ok], t[ok]
        s = slopes[t]
        z = s[:, 0] * u + s[:, 1] * v + s[:, 2]
        np.minimum.at(buffer, v * width + u, (_quantised(z, *depth_range) << 32) | t)


def _affine(
    edges: Float[np.ndarray, "n 3 3"], u: Int[np.ndarray, " n"], v: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    return edges[:, :, 0] * u[:, None] + edges[:, :, 1] * v[:, None] + edges[:, :, 2]


def _normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "t 3"]]:
    """Unit normals of the vertices (means of their faces, by area) and normals of the faces (length: twice the area)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros((len(vertices), 3))
    for i in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, i], face_normals[:, axis], minlength=len(vertices))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return normals, face_normals


def _shade(
    normals: Float[np.ndarray, "n 3"], base: Float[np.ndarray, "n 3"], softness: float
) -> Float[np.ndarray, "n 3"]:
    """Lambert shading with a key light, a fill light and a faint highlight; normals in the frame of the view.

    ``softness`` between 0 and 1 is the share of the light that comes from everywhere.
    """
    n = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    n = np.where(n[:, 2:] < 0.0, -n, n)
    key = np.clip(n @ _unit(-0.45, 0.55, 0.75), 0.0, None)
    fill = np.clip(n @ _unit(0.7, -0.1, 0.6), 0.0, None)
    shine = np.clip(n @ _unit(-0.25, 0.3, 0.95), 0.0, None) ** 30
    light = 0.26 + 0.66 * key + 0.22 * fill
    light = softness + (1.0 - softness) * light
    shine *= 0.12 * (1.0 - softness)
    return np.asarray(np.clip(base * light[:, None] + shine[:, None], 0.0, 1.0))


def _unit(x: float, y: float, z: float) -> Float[np.ndarray, "3"]:
    v = np.array([x, y, z])
    return np.asarray(v / np.linalg.norm(v))


def _finished(
    colours: Float[np.ndarray, "n 3"],
    which: Int[np.ndarray, "h2 w2"],
    depth: Float[np.ndarray, "h2 w2"],
    strength: float,
) -> UInt8[np.ndarray, "h w 3"]:
    """Edges darkened, on a white ground, averaged down to the size that was asked for; see :func:`finish`."""
    height, width = which.shape
    picture = np.empty((height // _OVERSAMPLING, width // _OVERSAMPLING, 3), dtype=np.uint8)
    finish(np.ascontiguousarray(colours, dtype=float), which, depth, strength, _OVERSAMPLING, _FAR_PX, picture)
    return picture
