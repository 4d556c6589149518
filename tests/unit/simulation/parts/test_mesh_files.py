"""Meshes from files: what is read, what is mended and said, and what is refused with a reason."""

import numpy as np
import pytest
import trimesh

from rotaline.errors import RigError
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.mesh_files import read_mesh_part


def _ball():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    mesh.apply_translation([3.0, -2.0, 5.0])
    return mesh


def _write(mesh, path):
    mesh.export(path)
    return path


def _without(mesh, keep):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".STL"])
def test_a_closed_mesh_is_read_as_it_is(tmp_path, suffix):
    mesh = _ball()
    mesh.export(tmp_path / ("ball" + suffix), file_type=suffix[1:].lower())
    part = read_mesh_part(tmp_path / ("ball" + suffix), material=Material(0.5))
    assert len(part.triangles) == len(mesh.faces)
    assert len(part.vertices) == len(mesh.vertices)
    assert np.allclose(part.bounds(), mesh.bounds, atol=1e-5)
    assert part.material.albedo == 0.5
    assert part.notes == ()
    t, _ = part.intersect(np.array([100.0, -2.0, 5.0]), np.array([[-1.0, 0.0, 0.0]]))
    assert t[0] == pytest.approx(100.0 - 18.0, abs=0.05)


def test_scale_and_stand(tmp_path):
    inches = _ball()
    inches.apply_scale(1 / 25.4)
    part = read_mesh_part(_write(inches, tmp_path / "a.stl"), 25.4, stand=True)
    lower, upper = part.bounds()
    assert upper - lower == pytest.approx(_ball().extents, abs=1e-4)
    assert lower[2] == pytest.approx(0.0, abs=1e-9)
    assert (lower + upper)[:2] == pytest.approx(0.0, abs=1e-9)


def test_inside_out_is_turned_and_said(tmp_path):
    mesh = _ball()
    mesh.invert()
    part = read_mesh_part(_write(mesh, tmp_path / "a.ply"))
    assert "inside out" in part.notes[0]
    t, _ = part.intersect(np.array([100.0, -2.0, 5.0]), np.array([[-1.0, 0.0, 0.0]]))
    assert np.isfinite(t[0])


def test_a_hole_is_measured_and_closed_only_if_asked_for(tmp_path):
    mesh = _ball()
    high = mesh.triangles_center[:, 2] > 5.0 + 12.0
    low = mesh.triangles_center[:, 2] < 5.0 - 14.5
    path = _write(_without(mesh, ~(high | low)), tmp_path / "open.stl")
    with pytest.raises(
        RigError, match=r"not closed: \d+ open edges around 2 holes; the largest is 1[89]\.\d mm"
    ) as caught:
        read_mesh_part(path)
    assert "x = 3" in str(caught.value)
    assert "fill_holes" in str(caught.value)
    part = read_mesh_part(path, fill_holes=True)
    assert "2 hole(s) were closed" in part.notes[0]
    top = part.bounds()[1, 2]
    assert 16.0 < top < 18.0
    t, _ = part.intersect(np.array([3.0, -2.0, 90.0]), np.array([[0.0, 0.0, -1.0]]))
    assert 90.0 - t[0] == pytest.approx(top, abs=1.0)  # the rim is jagged


def test_holes_that_touch_cannot_be_closed(tmp_path):
    mesh = trimesh.creation.box(extents=[20.0, 20.0, 20.0]).subdivide().subdivide()
    around = np.flatnonzero((mesh.faces == 30).any(axis=1))
    near = mesh.face_adjacency[np.isin(mesh.face_adjacency, around).all(axis=1)]
    first = around[0]
    neighbours = set(near[(near == first).any(axis=1)].ravel())
    opposite = next(i for i in around if i not in neighbours)
    keep = np.setdiff1d(np.arange(len(mesh.faces)), [first, opposite])
    with pytest.raises(RigError, match="touch"):
        read_mesh_part(_write(_without(mesh, keep), tmp_path / "a.ply"), fill_holes=True)


def test_triangles_of_both_senses(tmp_path):
    mesh = _ball()
    faces = mesh.faces.copy()
    faces[::7] = faces[::7, ::-1]
    with pytest.raises(RigError, match="opposite ways"):
        read_mesh_part(_write(trimesh.Trimesh(mesh.vertices, faces, process=False), tmp_path / "a.ply"))


def test_triangles_that_collapse_when_vertices_are_joined_are_left_out(tmp_path):
    mesh = _ball()
    a, b, _ = mesh.faces[0]
    vertices = np.vstack([mesh.vertices, mesh.vertices[a] + 1e-9])
    faces = np.vstack([mesh.faces, [a, len(vertices) - 1, b]])
    part = read_mesh_part(_write(trimesh.Trimesh(vertices, faces, process=False), tmp_path / "a.ply"))
    assert len(part.triangles) == len(mesh.faces)
    assert len(part.vertices) == len(mesh.vertices)


@pytest.mark.parametrize(("factor", "words"), [(1e-3, "scale = 1000"), (1e3, "smaller than a millimetre")])
def test_another_unit(tmp_path, factor, words):
    mesh = _ball()
    mesh.apply_scale(factor)
    path = _write(mesh, tmp_path / "a.ply")
    with pytest.raises(RigError, match=words):
        read_mesh_part(path)
    assert read_mesh_part(path, 1 / factor).bounds() == pytest.approx(_ball().bounds, abs=1e-3)


def test_flat(tmp_path):
    mesh = trimesh.creation.box(extents=[20.0, 20.0, 1e-6])
    with pytest.raises(RigError, match="flat"):
        read_mesh_part(_write(mesh, tmp_path / "a.ply"))


def test_vertices_that_are_no_numbers(tmp_path):
    mesh = _ball()
    vertices = mesh.vertices.copy()
    vertices[5] = np.nan
    with pytest.raises(RigError, match=r"1 of \d+ vertices are not finite"):
        read_mesh_part(_write(trimesh.Trimesh(vertices, mesh.faces, process=False), tmp_path / "a.ply"))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.stl", None, "no such file"),
        ("part.step", b"ISO-10303-21;", "step is no mesh"),
        ("part", b"", "without a suffix"),
        ("empty.stl", b"", "empty.stl"),
        ("noise.stl", bytes(range(256)) * 3, "noise.stl"),
        ("noise.ply", b"ply\nformat ascii 1.0\nend_header\n", "noise.ply"),
        ("text.obj", b"hello\n", "text.obj"),
    ],
)
def test_files_that_hold_no_mesh(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(RigError, match=words):
        read_mesh_part(tmp_path / name)


def test_a_cloud_of_points_is_no_mesh(tmp_path):
    trimesh.PointCloud(_ball().vertices).export(tmp_path / "cloud.ply")
    with pytest.raises(RigError, match=r"642 points but no triangles"):
        read_mesh_part(tmp_path / "cloud.ply")


def test_a_file_cut_off(tmp_path):
    path = _write(_ball(), tmp_path / "a.ply")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(RigError):
        read_mesh_part(path)


def test_too_many_triangles(tmp_path, monkeypatch):
    monkeypatch.setattr("rotaline.simulation.parts.mesh_files._MAX_TRIANGLES", 1000)
    with pytest.raises(RigError, match="1280 triangles, more than 1000"):
        read_mesh_part(_write(_ball(), tmp_path / "a.ply"))


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_scales_that_make_no_sense(tmp_path, scale):
    with pytest.raises(ValueError, match="scale"):
        read_mesh_part(tmp_path / "a.stl", scale)
