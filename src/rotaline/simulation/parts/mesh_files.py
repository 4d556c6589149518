"""Parts from STL, PLY and OBJ files, and what is wrong with those that cannot be rendered.

A file must hold a closed surface: a ray that enters through a hole would see the inside. Vertices that coincide are joined
(an STL repeats them for every triangle), and a surface that is inside out as a whole is turned, with a note: there is only
one way to do that. Holes are closed only if that is asked for, since nobody knows what was there.
"""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotaline.errors import RigError
from rotaline.simulation.parts.material import MATT, Material
from rotaline.simulation.parts.mesh import MeshPart, Triangles, open_half_edges, triangle_normals

_SUFFIXES = (".stl", ".ply", ".obj")
_MAX_TRIANGLES = 5_000_000
_LEAST_MM, _MOST_MM = 1.0, 1000.0
"""A part whose largest extent is outside of this was written in another unit."""

_JOIN = 1e-6
"""Vertices nearer than this fraction of the part's extent are one: the single precision of STL."""

_NEXT_HOLES = (
    "Close it in the program that wrote it (export a solid, or repair the mesh there), or let it be closed with a fan of "
    "triangles: fill_holes = true."
)


def read_mesh_part(
    path: Path,
    scale: float = 1.0,
    material: Material = MATT,
    *,
    stand: bool = False,
    fill_holes: bool = False,
    crease_deg: float = 30.0,
) -> MeshPart:
    """A part from a file of triangles.

    Parameters
    ----------
    path : STL, PLY or OBJ
    scale : mm of one unit of the file: 1000 for metres, 25.4 for inches
    material : Material
    stand : move it so that its lowest point is at z = 0 and the middle of its box on the z axis; otherwise it stays as in the
        file
    fill_holes : close every hole with triangles around its middle, and say so in the notes
    crease_deg : edges of more than this angle look sharp

    Returns
    -------
    MeshPart   its ``notes`` say what was changed

    Raises
    ------
    RigError
        If the file is missing, is no mesh, is empty or too large, has vertices that are no numbers, has holes or is wound in
        both senses, or if its size is that of another unit.
    ValueError
        If ``scale`` is not above zero.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"The scale of a mesh must be above zero, not {scale}.")
    vertices, triangles = _read(path)
    vertices = vertices * scale
    _check_size(path, vertices, triangles)
    vertices, triangles = _joined(vertices, triangles)
    vertices, triangles, notes = _closed(path, vertices, triangles, fill_holes)
    if _volume(vertices, triangles) < 0:
        triangles = triangles[:, ::-1]
        notes = (*notes, "The mesh was inside out, and was turned.")
    if stand:
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        vertices = vertices - [(lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2, lower[2]]
    return MeshPart(vertices, np.ascontiguousarray(triangles), material, crease_deg, notes)


def _read(path: Path) -> tuple[Float[np.ndarray, "v 3"], Triangles]:
    if not path.is_file():
        raise RigError(f"{path}: there is no such file. Expected a mesh: {', '.join(_SUFFIXES)}.")
    if path.suffix.lower() not in _SUFFIXES:
        raise RigError(
            f"{path}: {path.suffix or 'a file without a suffix'} is no mesh. Expected {', '.join(_SUFFIXES)}."
        )
    try:
        mesh = trimesh.load(path, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_geometry()
        vertices = np.array(getattr(mesh, "vertices", np.empty((0, 3))), dtype=float)
        triangles = np.array(getattr(mesh, "faces", np.empty((0, 3))), dtype=np.int64)
    except Exception as error:  # the readers raise whatever their parsers raise
        raise RigError(
            f"{path}: this is not a readable mesh ({error}). Export it again as binary STL or PLY."
        ) from error
    if len(triangles) == 0:
        what = f"{len(vertices)} points but no triangles" if len(vertices) else "nothing"
        raise RigError(f"{path}: expected a mesh of triangles, found {what}. Export a closed surface as STL or PLY.")
    if len(triangles) > _MAX_TRIANGLES:
        raise RigError(
            f"{path}: the mesh has {len(triangles)} triangles, more than {_MAX_TRIANGLES}. Simplify it: triangles smaller than "
            "a pixel sees change nothing."
        )
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise RigError(
            f"{path}: a triangle names vertex {triangles.max()}, and there are {len(vertices)}: the file is damaged or cut "
            "off. Write it again."
        )
    used = np.unique(triangles)
    bad = int((~np.isfinite(vertices[used])).any(axis=1).sum())
    if bad:
        raise RigError(
            f"{path}: {bad} of {len(used)} vertices are not finite numbers. Repair the mesh and export it again."
        )
    return vertices, triangles


def _check_size(path: Path, vertices: Float[np.ndarray, "v 3"], triangles: Triangles) -> None:
    used = vertices[np.unique(triangles)]
    extent = used.max(axis=0) - used.min(axis=0)
    largest = float(extent.max())
    found = f"{path}: the part would be {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g} mm"
    if largest < _LEAST_MM:
        raise RigError(
            f"{found}. Its unit is probably the metre or the inch: say scale = 1000 or scale = 25.4. Expected at least "
            f"{_LEAST_MM:g} mm."
        )
    if largest > _MOST_MM:
        raise RigError(
            f"{found}. Its unit is probably smaller than a millimetre: say scale = 0.001 for micrometres, or correct the scale. "
            f"Expected at most {_MOST_MM:g} mm."
        )
    if float(extent.min()) < 1e-3 * largest:
        raise RigError(f"{found}: it is flat, and encloses no volume. Export a solid.")


def _joined(
    vertices: Float[np.ndarray, "v 3"], triangles: Triangles
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "k 3"]]:
    """Vertices that coincide made one, triangles without area between them and vertices without triangles left out."""
    used, flat = np.unique(triangles, return_inverse=True)
    points = vertices[used]
    step = _JOIN * float((points.max(axis=0) - points.min(axis=0)).max())
    _, first, label = np.unique(
        np.round(points / step).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    joined = label.reshape(-1)[flat.reshape(-1, 3)]
    a, b, c = joined.T
    return points[first], joined[(a != b) & (b != c) & (c != a)]


def _closed(
    path: Path, vertices: Float[np.ndarray, "v 3"], triangles: Triangles, fill: bool
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "k 3"], tuple[str, ...]]:
    """The mesh if it is closed, or closed with fans of triangles if that is wanted."""
    edges = open_half_edges(triangles)
    if not len(edges):
        return vertices, triangles, ()
    _check_rims(path, edges)
    hole = _number_of_hole(edges)
    n_holes = int(hole.max()) + 1
    corners = vertices[edges[:, 0]]
    middles = np.stack([np.bincount(hole, corners[:, k]) for k in range(3)], axis=1) / np.bincount(hole)[:, None]
    widths = np.array([2 * np.linalg.norm(corners[hole == i] - middles[i], axis=1).max() for i in range(n_holes)])
    if fill:
        fans = np.column_stack([edges[:, 1], edges[:, 0], len(vertices) + hole])
        filled = np.concatenate([triangles, fans])
        if len(open_half_edges(filled)):
            raise RigError(f"{path}: {n_holes} holes cannot be closed, since some touch themselves. Repair the mesh.")
        note = f"{n_holes} hole(s) were closed, the largest {widths.max():.3g} mm wide."
        return np.concatenate([vertices, middles]), filled, (note,)
    x, y, z = middles[widths.argmax()]
    raise RigError(
        f"{path}: the mesh is not closed: {len(edges)} open edges around {n_holes} holes; the largest is {widths.max():.3g} mm "
        f"wide, at x = {x:.4g}, y = {y:.4g}, z = {z:.4g} mm. {_NEXT_HOLES}"
    )


def _check_rims(path: Path, edges: Int[np.ndarray, "e 2"]) -> None:
    """Refuse what is no hole: edges of more than two triangles, or of two that run along it in the same sense."""
    keys = edges[:, 0] * (int(edges.max()) + 1) + edges[:, 1]
    twice = len(keys) - len(np.unique(keys))
    if twice:
        raise RigError(
            f"{path}: at {twice} edges two triangles face opposite ways, or more than two meet. Expected a surface with one "
            "outside. Make the normals consistent, or export a single solid."
        )


def _number_of_hole(edges: Int[np.ndarray, "e 2"]) -> Int[np.ndarray, " e"]:
    """Open edges that hang together are around one hole."""
    _, flat = np.unique(edges, return_inverse=True)
    starts, ends = flat.reshape(-1, 2).T
    n = int(flat.max()) + 1
    _, label = connected_components(
        coo_array((np.ones(len(edges), bool), (starts, ends)), shape=(n, n)), directed=False
    )
    _, number = np.unique(label[starts], return_inverse=True)
    return np.asarray(number)


def _volume(vertices: Float[np.ndarray, "v 3"], triangles: Triangles) -> float:
    """Enclosed volume, mm3; negative if the triangles face inwards."""
    heights = np.einsum(
        "ti,ti->t", vertices[triangles[:, 0]] - vertices[triangles[0, 0]], triangle_normals(vertices, triangles)
    )
    return float(heights.sum() / 6)
