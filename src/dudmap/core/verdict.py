"""Verdict of a gate: every check with its figure, limit and overruling evidence."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Outcome(NamedTuple):
    """Outcome of one check.

    Attributes:
        at_least: The limit is a lower bound.
        overruled_by: Evidence that accepts a figure beyond its limit; empty for none.
    """

    name: str
    figure: float = np.nan
    limit: float = np.nan
    reason: str = ""
    at_least: bool = False
    overruled_by: str = ""

    @classmethod
    def of(
        cls, name: str, figure: float, limit: float, reason: str, *, at_least: bool = False, overruled_by: str = ""
    ) -> "Outcome":
        """Outcome of a comparison; ``reason`` may contain ``{figure}`` and ``{limit}``. NaN passes."""
        figure, limit = float(figure), float(limit)
        beyond = figure < limit if at_least else figure > limit
        reason = reason.format(figure=figure, limit=limit) if beyond else ""
        return cls(name, figure, limit, reason, at_least, overruled_by if beyond else "")

    @property
    def passed(self) -> bool:
        """Whether the figure is within its limit or accepted by evidence."""
        return not self.reason or bool(self.overruled_by)


@dataclass(frozen=True)
class Verdict:
    """Outcomes of the checks of a gate, in order; the first failed one decides."""

    outcomes: tuple[Outcome, ...] = ()

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> "Verdict":
        """Verdict of checks computed one by one, up to the first failed one."""
        done = list[Outcome]()
        for outcome in outcomes:
            done.append(outcome)
            if not outcome.passed:
                break
        return cls(tuple(done))

    def __add__(self, other: "Verdict") -> "Verdict":
        return Verdict(self.outcomes + other.outcomes)

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """The failed checks."""
        return tuple(outcome for outcome in self.outcomes if not outcome.passed)

    def __contains__(self, name: str) -> bool:
        """Whether the check of this name failed."""
        return any(outcome.name == name for outcome in self.failed)

    def figure(self, name: str) -> float:
        """Figure of the check of this name; NaN if unknown."""
        return next((outcome.figure for outcome in self.outcomes if outcome.name == name), np.nan)

    @property
    def accepted(self) -> bool:
        """Whether all checks passed."""
        return not self.failed

    @property
    def reason(self) -> str:
        """Reason of the first failed check; empty if all passed."""
        return self.failed[0].reason if self.failed else ""


ACCEPTED = Verdict()
