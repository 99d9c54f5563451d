"""The system of the DUDMap thesis (Hastürk, METU 2022), as chapter 4 describes it.

It is the baseline that the default system (``dudmap.core``) is compared with, and the system of the studies of
chapter 6. Each module follows a section of chapter 4, in the symbols of the thesis. If the text is silent, contradicts
itself or is wrong, "Reading:" in the docstring states the interpretation.

Block storage, meshing, ray casting, rigid motions, files and evaluation are the project's.
"""

from dudmap.thesis.slam import ThesisSlam
from dudmap.thesis_config import ThesisConfig

__all__ = ["ThesisConfig", "ThesisSlam"]
