"""Frames on their way to the disk: bounded, in order, and nothing thrown away."""

import threading

import numpy as np
import pytest

from rotaline.errors import OutputError
from rotaline.io.acquired_session import AcquiredSession, FrameRow
from rotaline.io.frame_writer import FrameWriter
from rotaline.vision.images import decode_image

N = 24


class Disk(AcquiredSession):
    """In place of a session: remembers what was added; ``before`` is called ahead of each frame."""

    def __init__(self, before=lambda n: None):
        self.added, self._before = [], before

    def add(self, folder, row, encoded):
        self._before(len(self.added))
        self.added.append((folder, row.image, decode_image(encoded, "a.png")))


def image(i):
    return np.full((40, 50), i, np.uint8)


def put(writer, i):
    writer.put("a", FrameRow(f"{i:04d}.png", None, True), image(i))


def put_all(writer, n, then=None):
    with writer:
        for i in range(n):
            put(writer, i)
        if then is not None:
            raise then


def test_frames_are_written_in_order_and_as_they_are():
    disk = Disk()
    with FrameWriter(disk, depth=3) as writer:
        for i in range(N):
            put(writer, i)
    assert [name for _, name, _ in disk.added] == [f"{i:04d}.png" for i in range(N)]
    for i, (_, _, written) in enumerate(disk.added):
        np.testing.assert_array_equal(written, image(i))


def test_a_slow_disk_makes_put_wait_and_memory_stays_bounded():
    """The disk goes on only when the other side cannot: with the frame in hand, a full queue, and one that waits to be put."""
    depth, n_put, ahead = 4, 0, []
    moved = threading.Condition()

    def wait_until_stuck(n_added):
        with moved:
            assert moved.wait_for(lambda: n_put >= min(n_added + depth + 1, N), timeout=30.0)
            ahead.append(n_put - n_added)

    disk = Disk(wait_until_stuck)
    with FrameWriter(disk, depth=depth) as writer:
        for i in range(N):
            put(writer, i)
            with moved:
                n_put += 1
                moved.notify()
            assert writer.n_waiting <= depth + 1
    assert max(ahead) == depth + 1
    assert [name for _, name, _ in disk.added] == [f"{i:04d}.png" for i in range(N)]


def test_flush_returns_when_all_is_written():
    disk = Disk()
    with FrameWriter(disk) as writer:
        for i in range(5):
            put(writer, i)
        writer.flush()
        assert len(disk.added) == 5
        assert writer.n_waiting == 0


def full_at(n):
    def before(n_added):
        if n_added == n:
            raise OutputError("no space left")

    return before


def test_after_an_error_nothing_more_is_written_and_everybody_hears_of_it():
    disk = Disk(full_at(3))
    writer = FrameWriter(disk, depth=2)
    with pytest.raises(OutputError, match="no space left"):
        put_all(writer, N)
    with pytest.raises(OutputError):
        writer.flush()
    assert [name for _, name, _ in disk.added] == ["0000.png", "0001.png", "0002.png"]


def test_an_error_at_the_end_is_not_lost():
    with pytest.raises(OutputError, match="no space left"):
        put_all(FrameWriter(Disk(full_at(0))), 1)


def test_what_waits_is_written_also_when_something_else_fails():
    disk = Disk()
    with pytest.raises(KeyboardInterrupt):
        put_all(FrameWriter(disk), 5, KeyboardInterrupt())
    assert len(disk.added) == 5
