"""Containers for frames: what reading costs and what they take on disk, for the choice in docs/decisions/0013.

    python benchmarks/containers.py SESSION [SESSION ...] [--capture NAME]

Reads frames by ranges of 16, from warm files, on one thread and on two, all containers in turn within each round. Needs
zarr, h5py and hdf5plugin beside the project's own packages. Times are the least of the rounds; MB are of pixels.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fsspec
import h5py
import hdf5plugin
import numpy as np
import zarr
from numcodecs import blosc
from zarr.codecs import BloscCodec

from rotaline.io.frame_images import read_source, read_sources
from rotaline.io.locations import Location
from rotaline.io.packed import compressor, encode_image, packed_images, parse_packed
from rotaline.io.packed_writer import PackedWriter
from rotaline.io.session import read_session
from rotaline.vision.images import encode_png, one_thread_per_image, read_image

RANGE = 16
ROUNDS = 7
Read = Callable[[int, int], Any]


@dataclass(frozen=True)
class Container:
    """One way to store the frames: its size and how a range of frames is read."""

    name: str
    n_bytes: int
    read: Read


@dataclass(frozen=True)
class Row:
    """Costs of one container: size relative to PNG, CPU and wall times a frame."""

    name: str
    size: float
    cpu_ms: float
    mb_per_s: float
    mb_per_s_two_threads: float


def measure(images: np.ndarray, folder: Path) -> list[Row]:
    """The table for frames (n, h, w) or (n, h, w, 3) of one capture."""
    containers = list(_containers(images, folder))
    n = len(images) // RANGE * RANGE
    ranges = [(a, a + RANGE) for a in range(0, n, RANGE)]
    best = {(c.name, threads): [np.inf, np.inf] for c in containers for threads in (1, 2)}
    for _ in range(ROUNDS):
        for container in containers:
            for threads in (1, 2):
                cpu, wall = time.process_time(), time.perf_counter()
                with ThreadPoolExecutor(threads) as pool:
                    list(pool.map(lambda r: container.read(*r) is None, ranges))  # noqa: B023
                now = time.process_time() - cpu, time.perf_counter() - wall
                best[container.name, threads] = [
                    min(a, b) for a, b in zip(best[container.name, threads], now, strict=True)
                ]
    png = containers[0].n_bytes
    mb = images[:n].nbytes / 1e6
    return [
        Row(c.name, c.n_bytes / png, best[c.name, 1][0] / n * 1e3, mb / best[c.name, 1][1], mb / best[c.name, 2][1])
        for c in containers
    ]


def _containers(images: np.ndarray, folder: Path) -> Iterator[Container]:
    pngs = []
    for i, image in enumerate(images):
        pngs.append(folder / f"{i}.png")
        pngs[-1].write_bytes(encode_png(image))
    yield Container("PNG files", sum(p.stat().st_size for p in pngs), lambda a, b: [read_image(p) for p in pngs[a:b]])
    bits = 8 * images.itemsize
    shuffle = compressor(images.shape[1:], bits)["shuffle"]
    filters = {
        "raw": ({}, None),
        f"lz4, {shuffle}": _filters("lz4", shuffle, images.itemsize),
        f"zstd, {shuffle}": _filters("zstd", shuffle, images.itemsize),
    }
    for name, (h5_filter, codec) in filters.items():
        for chunk in (1, 8, 16):
            path = folder / f"{name}-{chunk}.h5"
            with h5py.File(path, "w") as file:
                file.create_dataset("x", data=images, chunks=(chunk, *images.shape[1:]), **h5_filter)
            data = h5py.File(path, "r")["x"]
            yield Container(f"HDF5, {name}, {chunk} a chunk", path.stat().st_size, lambda a, b, d=data: d[a:b])
        for chunk in (1, 8, 16):
            path = folder / f"{name}-{chunk}.zarr"
            yield _zarr(f"zarr, {name}, {chunk} a chunk", path, images, codec, (chunk, *images.shape[1:]), None)
    path = folder / "sharded.zarr"
    one, shard = (1, *images.shape[1:]), (64, *images.shape[1:])
    yield _zarr(
        f"zarr, zstd, {shuffle}, 1 a chunk in shards of 64", path, images, filters[f"zstd, {shuffle}"][1], one, shard
    )
    yield _ours(images, folder / "ours", "the same, read by rotaline", str)
    over = fsspec.filesystem("memory")
    with (folder / f"zstd, {shuffle}-1.h5").open("rb") as stream:
        over.pipe_file("/one.h5", stream.read())
    data = h5py.File(over.open("/one.h5"), "r")["x"]
    yield Container(f"HDF5, zstd, {shuffle}, 1 a chunk, through fsspec", over.size("/one.h5"), lambda a, b: data[a:b])
    yield _ours(images, folder / "remote", "shards of 64 read by rotaline, through fsspec", _to_memory)


def _filters(name: str, shuffle: str, itemsize: int) -> tuple[dict[str, Any], BloscCodec]:
    h5 = hdf5plugin.Blosc(cname=name, clevel=5, shuffle={"noshuffle": 0, "bitshuffle": 2}[shuffle])
    return dict(h5), BloscCodec(cname=name, clevel=5, shuffle=shuffle, typesize=itemsize)


def _zarr(
    name: str, path: Path, images: np.ndarray, codec: BloscCodec | None, chunks: tuple[int, ...], shards: Any
) -> Container:
    array = zarr.create_array(
        path, shape=images.shape, dtype=images.dtype, chunks=chunks, shards=shards, compressors=codec, filters=None
    )
    array[:] = images
    array = zarr.open_array(path, mode="r")
    return Container(name, _size(path), lambda a, b: array[a:b])


def _ours(images: np.ndarray, path: Path, name: str, place: Callable[[Path], str]) -> Container:
    path.mkdir()
    with PackedWriter(path, "") as writer:
        writer.open_capture("a", "")
        for i, image in enumerate(images):
            writer.append("a", str(i), image.shape, 8 * image.itemsize, encode_image(image))
        writer.close_capture("a")
        writer.finish()
    content = parse_packed((path / "zarr.json").read_bytes(), "")
    sources = list(packed_images(Location(place(path)), content, "a").values())
    return Container(name, _size(path), lambda a, b: list(read_sources(sources[a:b])))


def _to_memory(path: Path) -> str:
    for file in path.rglob("*"):
        if file.is_file():
            fsspec.filesystem("memory").pipe_file(f"/{path.name}/{file.relative_to(path)}", file.read_bytes())
    return f"memory://{path.name}"


def levels(images: np.ndarray) -> list[tuple[int, float, float, float]]:
    """Levels of zstd: size relative to PNG, CPU ms a frame of compressing and of taking apart."""
    how = compressor(images.shape[1:], 8 * images.itemsize)
    shuffle = {"noshuffle": blosc.NOSHUFFLE, "bitshuffle": blosc.BITSHUFFLE}[how["shuffle"]]
    png = sum(len(encode_png(image)) for image in images)
    out = np.empty_like(images[0])
    result = []
    for level in (1, 3, 5, 7):
        start = time.process_time()
        data = [blosc.compress(image, b"zstd", level, shuffle, 0, how["typesize"]) for image in images]
        middle = time.process_time()
        for piece in data:
            blosc.decompress(piece, out)
        end = time.process_time()
        ms = 1e3 / len(images)
        result.append((level, sum(map(len, data)) / png, (middle - start) * ms, (end - middle) * ms))
    return result


def _size(path: Path) -> int:
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())


def main() -> None:
    """Print the table for each session."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", nargs="+")
    parser.add_argument("--capture", action="append", help="folder; default: all scans")
    parser.add_argument("--frames", type=int, default=64, help="at the most")
    arguments = parser.parse_args()
    one_thread_per_image()
    for place in arguments.sessions:
        session = read_session(place)
        chosen = [
            c for c in session.captures if (c.folder in arguments.capture if arguments.capture else c.role == "scan")
        ]
        sources = [f.source for c in chosen for f in c.frames][: arguments.frames]
        images = np.stack([read_source(s) for s in sources])
        with tempfile.TemporaryDirectory() as folder:
            rows = measure(images, Path(folder))
        kind = "colour" if images.ndim == 4 else "grey"
        print(
            f"\n{session.name}: {len(images)} frames, {images.shape[2]} x {images.shape[1]}, {kind}, {8 * images.itemsize} bit\n"
        )
        print("| container | size / PNG | CPU ms a frame | MB/s | MB/s, 2 threads |\n|---|---|---|---|---|")
        for r in rows:
            print(
                f"| {r.name} | {r.size:.2f} | {r.cpu_ms:.2f} | {r.mb_per_s:.0f} | {r.mb_per_s_two_threads:.0f} |",
                flush=True,
            )
        print("\n| zstd level | size / PNG | ms to compress | ms to take apart |\n|---|---|---|---|")
        for level, size, there, back in levels(images):
            print(f"| {level} | {size:.2f} | {there:.2f} | {back:.2f} |", flush=True)


if __name__ == "__main__":
    main()
