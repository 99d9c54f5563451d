"""YAML files as OpenCV and ROS write them, read by OpenCV."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.errors import DatasetError
from dudmap.input_files import LARGEST_TREE, read_text

if TYPE_CHECKING:
    import cv2


def read_yaml(path: Path) -> dict[str, Any]:
    """Nested dictionaries and lists of a YAML file; all numbers are floats.

    Raises:
        DatasetError: The file cannot be read or holds no keys.
    """
    import cv2

    try:
        text = read_text(path, LARGEST_TREE)
        if not text.startswith("%YAML"):  # OpenCV wants its own header, and lists to be indented
            text = "%YAML:1.0\n---\n" + re.sub(r"^( *)- ", r"\1  - ", text.removeprefix("---"), flags=re.MULTILINE)
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    except (cv2.error, SystemError):
        raise DatasetError(f"cannot read {path}; expected YAML of keys, numbers, texts and lists") from None
    if not storage.isOpened() or not storage.root().isMap():
        raise DatasetError(f"{path} holds no keys; expected YAML of keys and values")
    return _value(storage.root())


def _value(node: "cv2.FileNode") -> Any:  # noqa: ANN401
    if node.isMap():
        return {key: _value(node.getNode(key)) for key in node.keys()}
    if node.isSeq():
        return [_value(node.at(k)) for k in range(node.size())]
    return node.real() if node.isInt() or node.isReal() else node.string()
