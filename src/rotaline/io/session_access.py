"""What a session is read from: a folder of images or a packed session, on this machine or at an address."""

import os
from functools import cache

from rotaline.errors import SessionError
from rotaline.io.frame_images import ImageFile, ImageSource, RemoteImage
from rotaline.io.locations import PACKED_SUFFIX, Location, locate
from rotaline.io.packed import METADATA_FILE, PackedContent, PackedImage, packed_images, parse_packed
from rotaline.io.session_file import SESSION_FILE
from rotaline.vision.images import image_size, missing_image

FRAMES_FILE = "frames.csv"


class FolderFiles:
    """A folder with ``session.toml`` and folders of images; ``label`` is what users know it by."""

    def __init__(self, location: Location, label: str, session_file: bytes) -> None:
        self.label = label
        self._location = location
        self._session_file = session_file
        self._listing = cache(location.files)

    def session_file(self) -> bytes:
        """The content of ``session.toml``."""
        return self._session_file

    def has_folder(self, folder: str) -> bool:
        """The folder of a capture is there."""
        return self._location.has_folder(folder)

    def frames_file(self, folder: str) -> bytes:
        """The content of a folder's ``frames.csv``; raises an OSError where it is missing or cannot be read."""
        return self._location.read(f"{folder}/{FRAMES_FILE}")

    def image(self, folder: str, name: str) -> tuple[ImageSource, tuple[int, int]]:
        """An image and its width and height, from its header; also whether it ends as it should.

        Raises
        ------
        SessionError
            If it cannot be read; the message begins with its label.
        """
        label = f"{self.label}/{folder}/{name}"
        try:
            with self._location.open(f"{folder}/{name}") as stream:
                size = image_size(stream, label)
        except FileNotFoundError as error:
            raise missing_image(label) from error
        except OSError as error:
            raise SessionError(f"{label}: the image cannot be read ({error.strerror or error}).") from error
        if self._location.is_local:
            return ImageFile(f"{self._location.address}/{folder}/{name}"), size
        state = self._listing(folder).get(name)
        if state is None:
            raise missing_image(label)
        return RemoteImage(self._location.address, f"{folder}/{name}", state.size, state.changed), size


class PackedFiles:
    """A packed session, as if it were a folder."""

    def __init__(self, location: Location, label: str, content: PackedContent) -> None:
        self.label = label
        self.content = content
        self._images = cache(lambda folder: packed_images(location, content, folder))

    def session_file(self) -> bytes:
        """See :class:`FolderFiles`."""
        return self.content.session_toml.encode()

    def has_folder(self, folder: str) -> bool:
        """See :class:`FolderFiles`."""
        return folder in self.content.captures

    def frames_file(self, folder: str) -> bytes:
        """See :class:`FolderFiles`."""
        return self.content.captures[folder].frames_csv.encode()

    def image(self, folder: str, name: str) -> tuple[ImageSource, tuple[int, int]]:
        """See :class:`FolderFiles`; nothing is read for it."""
        found: PackedImage | None = self._images(folder).get(name)
        if found is None:
            why = self.content.captures[folder].left_out.get(name, "the image is not in the packed session.")
            raise SessionError(f"{self.label}/{folder}/{name}: {why}")
        return found, (found.shape[1], found.shape[0])


SessionFiles = FolderFiles | PackedFiles


def open_session_files(place: str | os.PathLike[str]) -> SessionFiles:
    """What stands at a path or an address.

    Raises
    ------
    SessionError
        If that is no session, or cannot be opened; the message begins with the place.
    """
    location, label = locate(place), os.fspath(place).rstrip("/") or "/"
    if (metadata := _content_of(location, METADATA_FILE, label)) is not None:
        return PackedFiles(location, label, parse_packed(metadata, label))
    if (text := _content_of(location, SESSION_FILE, label)) is not None:
        return FolderFiles(location, label, text)
    raise SessionError(f"{label}: {_what_else(location)}")


def is_session(place: str | os.PathLike[str]) -> bool:
    """It has the look of a session: an address, or a folder with one of its files."""
    location = locate(place)
    return not location.is_local or any(
        os.path.isfile(f"{location.address}/{name}") for name in (SESSION_FILE, METADATA_FILE)
    )


def _content_of(location: Location, name: str, label: str) -> bytes | None:
    try:
        return location.read(name)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise SessionError(f"{label}/{name}: the file cannot be read ({error.strerror}).") from error


def _what_else(location: Location) -> str:
    kind = location.kind()
    if kind == "nothing":
        return f"there is no such folder. Expected a session: a folder with {SESSION_FILE}."
    if kind == "file":
        return f"this is a file; expected a session: a folder with {SESSION_FILE}."
    if location.address.rstrip("/").endswith(PACKED_SUFFIX):
        return (
            f"this packed session is not complete: there is no {METADATA_FILE} in it, which is written last. "
            "Copy it again from where it was made, or pack the session again."
        )
    inside = "the folder is empty" if location.is_empty() else f"there is no {SESSION_FILE} in it"
    return f"{inside}. A session is a folder with {SESSION_FILE} and folders of images."
