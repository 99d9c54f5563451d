"""Whatever a class of the algorithm changes after it was made is part of the state, or is named here with a reason."""

import ast
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path

import dudmap.core
from dudmap.app.state.annotations import fields_of
from dudmap.core.state import Stateful, remembered

ROOT = Path(dudmap.core.__file__).parent
CHANGING = {"append", "appendleft", "extend", "pop", "popleft", "clear", "update", "add", "remove", "insert", "put"}
"""Methods that change a list, a dictionary or a set."""
NO_STATE = {
    "what stands in rows of the database": (
        "VoxelBlocks.geometry", "VoxelBlocks.colors", "VoxelBlocks.geometry_mirror", "VoxelBlocks.colors_mirror",
        "BlockPager._archive", "BlockPager._archived", "FrameStore.archived", "FrameStore._first_own",
    ),
    "what follows from the rest": (
        "BlockWindow.cells", "FineBlocks.children", "FineBlocks.parents", "VoxelBlocks.num_entries",
        "VoxelBlocks.num_slots", "VoxelBlocks.table", "KeyframeDatabase._unsettled",
    ),
    "threads, files, and what is of one process": (
        "BlockPager._returned", "BlockPager._store", "SiftExtractor._detector", "FrameStore._encoder",
        "FrameStore._file", "FrameStore._pending", "LoopCloser._executor", "StageTimer._running", "StageTimer._stage",
        "StageTimer._within", "TsdfVolume.map_id", "_Uncollected._nested", "_Uncollected._collects",
    ),
    "observers, which begin anew": (
        "IncrementalMesh._coords_of", "IncrementalMesh._map_id", "IncrementalMesh._seen", "IncrementalMesh.chunks",
        "VolumeMirror._copied",
    ),
    "objects that belong to another one's state": (
        "Mapper._redundancy", "Slam.mapper", "FrontEnd.detector", "FrontEnd.motion",
        "BlockTree.blocks", "Atlas.volume",
    ),
    "settings of maps that are only looked at (``extend_range``)": (
        "TsdfVolume.depth_max", "TsdfVolume._reach", "TsdfVolume._window_cells",
    ),
}  # fmt: skip
"""Attributes that are no part of the state, by the reason."""


def changed_attributes(cls):
    """Attributes of ``self`` that the methods of a class set or change, but for its constructor."""
    for method in cls.body:
        if not isinstance(method, ast.FunctionDef) or method.name in ("__init__", "__post_init__"):
            continue
        for node in ast.walk(method):
            if isinstance(node, ast.Assign | ast.Delete):
                targets = node.targets
            elif isinstance(node, ast.AugAssign | ast.AnnAssign):
                targets = [node.target]
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
                targets = [node.func.value]
            else:
                continue
            for target in targets:
                for one in target.elts if isinstance(target, ast.Tuple) else [target]:
                    inner = one.value if isinstance(one, ast.Subscript) else one
                    if isinstance(inner, ast.Attribute) and getattr(inner.value, "id", "") == "self":
                        yield inner.attr


def test_what_changes_is_part_of_the_state():
    forgotten, exempt = [], {name for names in NO_STATE.values() for name in names}
    unused = set(exempt)
    for path in sorted(ROOT.rglob("*.py")):
        if path.is_relative_to(ROOT / "backends"):  # back ends hold nothing that is part of the state
            continue
        name = ".".join(("dudmap.core", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ClassDef):
                continue
            cls = getattr(import_module(name), node.name)
            known = remembered(cls) if issubclass(cls, Stateful) else fields_of(cls) if is_dataclass(cls) else {}
            for attribute in sorted(set(changed_attributes(node)) - set(known)):
                key = f"{node.name}.{attribute}"
                unused.discard(key)
                if key not in exempt:
                    forgotten.append(key)
    assert not forgotten, "\n".join(forgotten)
    assert unused == set()
