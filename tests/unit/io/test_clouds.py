import numpy as np
import pytest
import trimesh

from rotaline.errors import OutputError, SessionError
from rotaline.io.clouds import CloudWriter, read_points, write_cloud, write_mesh
from rotaline.scanning.cloud import PointCloud

RNG = np.random.default_rng(5)


def _cloud(n):
    points = RNG.normal(size=(n, 3)) * 50
    u_noise, u_calibration = np.full(n, 0.004), np.linspace(0.001, 0.002, n)
    return PointCloud(points, points, np.arange(n) * 1.0, np.linspace(0, 6, n), np.arange(n), u_noise, u_calibration)


def test_a_cloud_is_readable_with_all_its_properties(tmp_path):
    cloud = _cloud(100)
    write_cloud(tmp_path / "c.ply", cloud)
    assert read_points(tmp_path / "c.ply") == pytest.approx(cloud.points_table, abs=2e-5)
    vertex = trimesh.load(tmp_path / "c.ply").metadata["_ply_raw"]["vertex"]["data"]
    assert vertex["angle_deg"].ravel() == pytest.approx(np.degrees(cloud.angle_rad), abs=1e-3)
    assert vertex["u_noise"].ravel() == pytest.approx(0.004)
    assert vertex["u_calibration"].ravel() == pytest.approx(cloud.u_calibration_mm)
    assert (vertex["frame"].ravel() == cloud.frame).all()


def test_clouds_of_other_programs_are_read(tmp_path):
    points = RNG.normal(size=(20, 3))
    np.savetxt(tmp_path / "a.xyz", points)
    np.savetxt(tmp_path / "a.csv", points, delimiter=",")
    header = "ply\nformat ascii 1.0\nelement vertex 20\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "\n".join(" ".join(map(repr, map(float, p))) for p in points))
    for name in ("a.xyz", "a.csv", "a.ply"):
        assert read_points(tmp_path / name) == pytest.approx(points)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_a_mesh_comes_back(tmp_path, suffix):
    box = trimesh.creation.box((1, 2, 3))
    write_mesh(tmp_path / f"m{suffix}", np.asarray(box.vertices), np.asarray(box.faces))
    back = trimesh.load(tmp_path / f"m{suffix}")
    assert back.volume == pytest.approx(6.0)
    assert back.is_watertight


@pytest.mark.parametrize("name", ["none.ply", "text.ply", "empty.ply", "a.docx"])
def test_what_is_no_cloud_is_refused(tmp_path, name):
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "a.docx").write_text("hello")
    write_cloud(tmp_path / "empty.ply", _cloud(0))
    with pytest.raises(SessionError, match=name):
        read_points(tmp_path / name)


@pytest.mark.parametrize("ends", [(), (1,), (3, 3, 120)], ids=["one", "two", "four"])
def test_a_cloud_written_in_pieces_is_the_same_file(tmp_path, ends):
    cloud = _cloud(150)
    write_cloud(tmp_path / "whole.ply", cloud)
    with CloudWriter(tmp_path / "pieces.ply") as writer:
        for start, end in zip((0, *ends), (*ends, 150), strict=True):
            writer.append(cloud.select((cloud.frame >= start) & (cloud.frame < end)))
            assert not (tmp_path / "pieces.ply").exists()
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt(), FileNotFoundError("of a frame")], ids=["interrupt", "frame"])
def test_a_cloud_that_was_not_finished_leaves_the_old_file_and_the_error_as_they_were(tmp_path, error):
    write_cloud(tmp_path / "c.ply", _cloud(3))
    before = (tmp_path / "c.ply").read_bytes()

    def write_some():
        with CloudWriter(tmp_path / "c.ply") as writer:
            writer.append(_cloud(10))
            raise error

    with pytest.raises(type(error)) as raised:
        write_some()
    assert raised.value is error
    assert (tmp_path / "c.ply").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_a_cloud_that_cannot_be_written_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"), CloudWriter(tmp_path / "file" / "c.ply"):
        pass
