"""Log of changes of the tracking state and the map."""

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dudmap.core.result import FrameResult

log = logging.getLogger(__name__)


def log_changes(before: "FrameResult | None", result: "FrameResult") -> None:
    """Log how a frame differs from the frame ``before``: lost, found again, a new map, a closed loop."""
    time, was_lost = result.timestamp, before is not None and before.status == "lost"
    if result.status == "rejected":
        log.warning("%.3f s: frame ignored, %s", time, result.verdict.reason)
    elif result.status == "lost":
        if not was_lost:
            log.warning("%.3f s: lost, %s", time, result.verdict.reason)
    elif before is not None and result.submap > before.submap:
        log.info("%.3f s: map %d begins", time, result.submap + 1)
    elif "relocalized" in result.events:
        log.info("%.3f s: tracked again at a known place of map %d", time, result.submap + 1)
    elif was_lost:
        log.info("%.3f s: tracked again", time)
    if "corrected" in result.events:
        again = "started" in result.events
        log.info("%.3f s: %s", time, "the young map is begun again" if again else "a loop is closed")
