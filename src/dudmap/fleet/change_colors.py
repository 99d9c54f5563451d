"""Surface that stands where it stood and has other colours: a poster, a screen, a painted wall."""

import numpy as np

from dudmap.fleet.change_evidence import Evidence
from dudmap.fleet.change_objects import Piece


def recolored_pieces(found: Evidence, min_size: float) -> list[tuple[Piece, float]]:
    """Pieces with other colours, and the share of their surface that has them."""
    return []
