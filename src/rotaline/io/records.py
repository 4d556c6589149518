"""Results of a stage on disk: any tree of frozen dataclasses, tuples, dictionaries, arrays and numbers.

One ``.npz`` file: the arrays as they are, and a JSON text with the tree. Classes are stored by name and looked up in this
package only, so that a foreign file can never run code.
"""

import dataclasses
import json
import struct
import zipfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from rotaline.errors import SessionError
from rotaline.io.files import whole_file

_PACKAGE = "rotaline."


def write_record(path: Path, value: Any, compressed: bool = False) -> None:
    """Write a value so that :func:`read_record` gives it back.

    Raises
    ------
    TypeError
        If the tree holds something other than dataclasses of this package, tuples, lists, dictionaries with text keys,
        arrays, poses, numbers, text and None.
    """
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps(_encode(value, arrays))
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        how = (
            (zipfile.ZIP_DEFLATED, 1) if compressed else (zipfile.ZIP_STORED, None)
        )  # measured values hardly get smaller by more
        with zipfile.ZipFile(stream, "w", compression=how[0], compresslevel=how[1]) as archive:
            for name, array in {"tree": np.array(tree), **arrays}.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, array, allow_pickle=False)


def read_record(path: Path) -> Any:
    """Read what :func:`write_record` wrote.

    Raises
    ------
    SessionError
        If the file is missing, damaged or from another version of the program.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            return _decode(json.loads(str(arrays["tree"])), arrays)
    except (
        OSError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        ImportError,
        EOFError,
        struct.error,
        zipfile.BadZipFile,
    ) as error:
        raise SessionError(
            f"{path}: this stored result cannot be read ({error}). Start `rotaline run` again; it is made anew."
        ) from error


def _encode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, RigidTransform):
        return {"pose": _encode(value.as_matrix(), arrays)}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_encode(entry, arrays) for entry in value]}
    if isinstance(value, dict):
        return {"dict": {key: _encode(entry, arrays) for key, entry in value.items()}}
    kind = type(value)
    if dataclasses.is_dataclass(value) and kind.__module__.startswith(_PACKAGE):
        fields = {f.name: _encode(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {"class": f"{kind.__module__}:{kind.__qualname__}", "fields": fields}
    raise TypeError(f"a record cannot hold a {kind.__module__}.{kind.__qualname__}")


def _decode(node: Any, arrays: Any) -> Any:
    if not isinstance(node, dict):
        return node
    if "array" in node:
        return arrays[node["array"]]
    if "pose" in node:
        return RigidTransform.from_matrix(_decode(node["pose"], arrays))
    if "tuple" in node:
        return tuple(_decode(entry, arrays) for entry in node["tuple"])
    if "list" in node:
        return [_decode(entry, arrays) for entry in node["list"]]
    if "dict" in node:
        return {key: _decode(entry, arrays) for key, entry in node["dict"].items()}
    module, _, name = node["class"].partition(":")
    if not module.startswith(_PACKAGE):
        raise ValueError(f"unknown class {node['class']}")
    kind = getattr(import_module(module), name)
    if not dataclasses.is_dataclass(kind):
        raise ValueError(f"unknown class {node['class']}")
    return kind(**{key: _decode(entry, arrays) for key, entry in node["fields"].items()})  # type: ignore[operator]
