"""YAML files as OpenCV, ROS and Kalibr write them."""

import re
from pathlib import Path
from typing import Any

import yaml

from dudmap.errors import DatasetError
from dudmap.input_files import LARGEST_TREE, read_text


def read_yaml(path: Path) -> dict[str, Any]:
    """Nested dictionaries and lists of a YAML file; OpenCV's header and type names are left out.

    Raises:
        DatasetError: The file cannot be read, holds no keys, or uses aliases, which could make it endless.
    """
    try:
        text = re.sub(r"^%YAML.*\n|!!opencv-\w+", "", read_text(path, LARGEST_TREE))
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise DatasetError(f"{path} uses aliases (*name); expected YAML of plain keys and values")
        content = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    except (yaml.YAMLError, RecursionError, ValueError):
        raise DatasetError(f"cannot read {path}; expected YAML of keys, numbers, texts and lists") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{path} holds no keys; expected YAML of keys and values")
    return content
