"""Clouds and meshes as files: PLY and STL, in the table frame, mm."""

import re
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import SessionError
from rotaline.io.files import output_error, whole_file
from rotaline.scanning.cloud import PointCloud

_FIELDS = (
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("intensity", "f4"),
    ("angle_deg", "f4"),
    ("frame", "i4"),
    ("u_noise", "f4"),
    ("u_calibration", "f4"),
)
_PLY_NAMES = {"f4": "float", "i4": "int"}
_RECORD = np.dtype([(name, "<" + kind) for name, kind in _FIELDS])
_PIECE = 65536
"""Points that are turned into records, or back, at a time."""


class CloudWriter:
    """Writes clouds one after the other as one binary PLY, as :func:`write_cloud` writes one.

    Used with ``with``: the file takes its place, whole, when the block ends without an error. What is in memory does not grow with the
    number of points.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._n = 0

    def __enter__(self) -> "CloudWriter":
        """Open a file beside ``path``.

        Raises
        ------
        OutputError
            If it cannot be written; ``append`` and the end of the block raise it too.
        """
        with ExitStack() as stack:
            temporary = stack.enter_context(whole_file(self._path))
            self._stream = stack.enter_context(temporary.open("wb"))
            self._stream.write(_header(0))
            self._stack = stack.pop_all()
        return self

    def append(self, cloud: PointCloud) -> None:
        """Add the points of a cloud after those that are there."""
        try:
            for start in range(0, len(cloud), _PIECE):
                self._stream.write(_records(cloud, slice(start, start + _PIECE)).tobytes())
        except OSError as error:
            raise output_error(self._path, error) from error
        self._n += len(cloud)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Put the file in its place, or leave nothing of it."""
        if error is not None:
            # whatever happened in the block is not the file's fault: only make it clean up
            self._stack.__exit__(_AbandonedError, _AbandonedError(), None)
            return
        with self._stack:
            self._stream.seek(0)
            self._stream.write(_header(self._n))


class _AbandonedError(Exception):
    """The block of a writer ended with an error."""


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY: x, y, z (mm), intensity, angle_deg (right-handed about z), frame, u_noise, u_calibration.

    ``u_noise`` and ``u_calibration`` are standard uncertainties (k = 1, mm) from the stripe's noise and from the calibration; NaN
    where not known.
    """
    with CloudWriter(path) as writer:
        writer.append(cloud)


def _header(n: int) -> bytes:
    """Of the same length for every number of points: a comment fills up."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment rotaline point cloud; table frame, z on the rotation axis; mm",
        "comment standard uncertainties (k = 1), mm: u_noise from the stripe, u_calibration common to many points",
        "comment " + "." * (20 - len(str(n))),
        f"element vertex {n}",
        *(f"property {_PLY_NAMES[kind]} {name}" for name, kind in _FIELDS),
        "end_header\n",
    ]
    return "\n".join(lines).encode("ascii")


def _records(cloud: PointCloud, piece: slice) -> np.ndarray:
    """Some of the points as they stand in the file."""
    points = cloud.points_table[piece]
    records = np.empty(len(points), dtype=_RECORD)
    records["x"], records["y"], records["z"] = points.T
    records["intensity"] = cloud.intensity[piece]
    records["angle_deg"] = np.degrees(cloud.angle_rad[piece])
    records["frame"] = cloud.frame[piece]
    records["u_noise"] = cloud.u_mm[piece]
    records["u_calibration"] = cloud.u_calibration_mm[piece]
    return records


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """The points of a cloud or the vertices of a mesh that any program wrote: PLY, OBJ, STL, XYZ.

    Returns
    -------
    (n, 3)   in the file's frame and unit (taken as mm)

    Raises
    ------
    SessionError
        If the file is missing, cannot be read, or holds no points.
    """
    if not path.is_file():
        raise SessionError(f"{path}: there is no such file. Expected a point cloud, for example a .ply.")
    try:
        if path.suffix.lower() in (".xyz", ".txt", ".asc", ".csv"):
            points = np.loadtxt(
                path, usecols=(0, 1, 2), delimiter="," if path.suffix.lower() == ".csv" else None, ndmin=2
            )
        else:
            import trimesh

            geometry = trimesh.load(path, process=False)
            if isinstance(geometry, trimesh.Scene):
                geometry = geometry.to_geometry()
            points = np.asarray(getattr(geometry, "vertices", np.empty((0, 3))), dtype=float)
    except Exception as error:  # the readers raise whatever their parsers raise
        raise SessionError(
            f"{path}: this is not a readable point cloud ({error}). Expected PLY, OBJ, STL or XYZ."
        ) from error
    declared = _declared_vertices(path)
    if declared is not None and len(points) < declared:
        raise SessionError(
            f"{path}: the file is cut off; its header announces {declared} points, found {len(points)}. Write it again."
        )
    points = points[np.isfinite(points).all(axis=1)] if points.ndim == 2 and points.shape[1] == 3 else np.empty((0, 3))
    if len(points) == 0:
        raise SessionError(f"{path}: there are no points in this file.")
    return points


def _declared_vertices(path: Path) -> int | None:
    """The number of points in a PLY's header: its reader is content with fewer."""
    if path.suffix.lower() != ".ply":
        return None
    with path.open("rb") as stream:
        found = re.search(rb"element vertex (\d+)", stream.read(4096))
    return int(found[1]) if found else None


def write_mesh(path: Path, vertices_table: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
    """Write a mesh as binary PLY or STL, by the suffix of ``path``; mm, table frame."""
    import trimesh

    mesh = trimesh.Trimesh(vertices_table, triangles, process=False)
    with whole_file(path) as temporary:
        mesh.export(temporary)
