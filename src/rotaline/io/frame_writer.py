"""Frames on their way to the disk: encoded side by side, written in order, in a bounded queue.

Where the disk is slower than the camera, :meth:`FrameWriter.put` waits. It never throws a frame away.
"""

import queue
import threading
from concurrent.futures import Future, ThreadPoolExecutor

from rotaline.io.acquired_session import AcquiredSession, FrameRow
from rotaline.vision.images import Image, encode_png

_Job = tuple[str, FrameRow, "Future[bytes]"]


class FrameWriter:
    """Writes frames into a session while the next ones are taken. A context: leaving it writes what waits.

    Parameters
    ----------
    session : AcquiredSession
    depth : frames that may wait, at most
    encoders : frames that are encoded side by side
    """

    def __init__(self, session: AcquiredSession, depth: int = 16, encoders: int = 2) -> None:
        self._session = session
        self._jobs: queue.Queue[_Job | None] = queue.Queue(depth)
        self._encoders = ThreadPoolExecutor(encoders, thread_name_prefix="encode")
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="frame writer", daemon=True)
        self._thread.start()

    def __enter__(self) -> "FrameWriter":
        """The writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Write what waits, then end; an error of the writing shows itself unless another one is on its way."""
        self._jobs.put(None)
        self._thread.join()
        self._encoders.shutdown()
        if kind is None:
            self._raise()

    @property
    def n_waiting(self) -> int:
        """Frames that are not on disk yet."""
        return self._jobs.unfinished_tasks

    def put(self, folder: str, row: FrameRow, image: Image) -> None:
        """Hand over a frame; waits while the queue is full. The image must not be changed afterwards.

        Raises
        ------
        OutputError
            If an earlier frame could not be written; none after it was.
        """
        self._raise()
        self._jobs.put((folder, row, self._encoders.submit(encode_png, image)))

    def flush(self) -> None:
        """Return when all frames are on disk; raises as :meth:`put`."""
        self._jobs.join()
        self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if self._error is None:
                folder, row, encoded = job
                try:
                    self._session.add(folder, row, encoded.result())
                except BaseException as error:
                    self._error = error
            self._jobs.task_done()
        self._jobs.task_done()
